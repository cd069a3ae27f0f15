# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from placerec.training.losses import (
    draw_partners,
    multi_constraint_loss,
    simplified_multi_constraint_loss,
    triplet_loss,
)

ALPHA, BETA = 0.5, 0.3
SHAPES = st.tuples(st.integers(1, 4), st.integers(1, 5), st.integers(2, 5), st.integers(1, 6))


def _sets(shape, seed):
    sets, positives, negatives, dimension = shape
    rng = np.random.default_rng(seed)

    def unit(count):
        rows = rng.normal(size=(sets, count, dimension))
        return torch.from_numpy(rows / np.linalg.norm(rows, axis=2, keepdims=True))

    partners = torch.from_numpy(draw_partners(sets, negatives, rng))
    return unit(positives), unit(negatives), partners


def _d2(a, b):
    return float(((a - b) ** 2).sum())


def _naive_full(positives, negatives, partners, alpha, beta):
    c = sum(positives) / len(positives)
    terms = []
    for x_i in positives:
        for j, x_j in enumerate(negatives):
            first = max(0.0, _d2(x_i, c) + alpha - _d2(x_j, c))
            second = max(0.0, _d2(x_i, c) + beta - _d2(x_j, negatives[partners[j]]))
            terms.append(first + second)
    return sum(terms) / len(terms)


def _naive_simplified(positives, negatives, partners, alpha, beta):
    c = sum(positives) / len(positives)
    farthest = max(_d2(x, c) for x in positives)
    nearest = min(range(len(negatives)), key=lambda j: _d2(negatives[j], c))
    apart = _d2(negatives[nearest], negatives[partners[nearest]])
    first = max(0.0, farthest + alpha - _d2(negatives[nearest], c))
    return first + max(0.0, farthest + beta - apart)


@pytest.mark.parametrize(
    ("loss", "naive"),
    [
        (multi_constraint_loss, _naive_full),
        (simplified_multi_constraint_loss, _naive_simplified),
    ],
)
@settings(max_examples=40, deadline=None)
@given(shape=SHAPES, seed=st.integers(0, 2**32 - 1), alpha=st.floats(0, 2), beta=st.floats(0, 2))
def test_multi_constraint_is_the_loop_over_sets_and_images(loss, naive, shape, seed, alpha, beta):
    positives, negatives, partners = _sets(shape, seed)
    expected = [
        naive(p.numpy(), n.numpy(), k.numpy(), alpha, beta)
        for p, n, k in zip(positives, negatives, partners, strict=True)
    ]
    got = loss(positives, negatives, partners, alpha, beta)
    np.testing.assert_allclose(got.numpy(), expected, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(shape=SHAPES, seed=st.integers(0, 2**32 - 1))
def test_triplet_is_the_loop_over_the_triplets_of_a_set(shape, seed):
    positives, negatives, _ = _sets(shape, seed)
    images = np.random.default_rng(seed).integers(0, 3, positives.shape[:2])
    is_pair = torch.from_numpy(images[:, :, None] != images[:, None, :])
    for s, got in enumerate(triplet_loss(positives, negatives, is_pair, ALPHA)):
        terms = [
            max(0.0, _d2(a, p) + ALPHA - _d2(a, n))
            for i, a in enumerate(positives[s].numpy())
            for j, p in enumerate(positives[s].numpy())
            for n in negatives[s].numpy()
            if images[s, i] != images[s, j]
        ]
        assert float(got) == pytest.approx(np.mean(terms) if terms else 0.0, abs=1e-12)


def test_triplet_by_hand():
    a, p, n = torch.tensor([[[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]]]).split(1, dim=1)
    # |a-p|^2 = 2 and |a-n|^2 = 4: the margin is kept; the other way round it is missed by 2.5.
    # With p as the anchor |p-n|^2 = 2 misses it by 0.5, with n as the anchor |n-p|^2 = 2 by 2.5.
    pair = ~torch.eye(2, dtype=torch.bool)[None]
    assert triplet_loss(torch.cat([a, p], dim=1), n, pair, ALPHA).tolist() == [(0.0 + 0.5) / 2]
    assert triplet_loss(torch.cat([a, n], dim=1), p, pair, ALPHA).tolist() == [(2.5 + 2.5) / 2]


def test_multi_constraint_by_hand():
    # The centre is (0.5, 0.5): both positives are 0.5 from it. Of the negatives, (1, 0) is 0.5
    # from it and (-1, 0) is 2.5; they are 4 apart.
    positives = torch.tensor([[[1.0, 0.0], [0.0, 1.0]]])
    negatives = torch.tensor([[[1.0, 0.0], [-1.0, 0.0]]])
    partners = torch.tensor([[1, 0]])
    # Full: i = 1, 2 each give 0.5 + 0.5 - 0.5 for the first negative and nothing for the second.
    assert float(multi_constraint_loss(positives, negatives, partners, ALPHA, BETA)[0]) == 0.25
    loss = simplified_multi_constraint_loss(positives, negatives, partners, ALPHA, BETA)
    assert float(loss[0]) == 0.5


def test_negatives_that_look_alike_are_pushed_apart():
    # Far from the centre, but the same: only the second constraint is missed, by 0 + 0.3 - 0.
    positives = torch.tensor([[[1.0, 0.0], [1.0, 0.0]]])
    negatives = torch.tensor([[[-1.0, 0.0], [-1.0, 0.0]]])
    partners = torch.tensor([[1, 0]])
    for loss in (multi_constraint_loss, simplified_multi_constraint_loss):
        found = loss(positives, negatives, partners, ALPHA, BETA)
        assert float(found[0]) == pytest.approx(0.3)
    pair = torch.tensor([[[False, True], [True, False]]])
    assert float(triplet_loss(positives, negatives, pair, ALPHA)[0]) == 0.0


def test_partner_of_the_nearest_negative_decides_in_the_simplified_form():
    positives = torch.tensor([[[1.0, 0.0, 0.0]]])
    negatives = torch.tensor([[[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.8, 0.6, 0.0]]])
    # Nearest is the third, 0.4 away: 0.1 for DR2; it is 0.8 from the first and 2 from the second.
    for partner, expected in ((0, 0.1 + 0.2), (1, 0.1)):
        partners = torch.tensor([[1, 0, partner]])
        loss = simplified_multi_constraint_loss(positives, negatives, partners, ALPHA, 1.0)
        assert float(loss[0]) == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("loss", [multi_constraint_loss, simplified_multi_constraint_loss])
def test_gradient_of_multi_constraint(loss):
    positives, negatives, partners = _sets((3, 4, 4, 5), seed=1)

    def of(p, n):
        return loss(p, n, partners, 1.9, 1.7)  # margins so wide that hardly a term is zero

    assert torch.autograd.gradcheck(of, (positives.requires_grad_(), negatives.requires_grad_()))


def test_gradient_of_triplet():
    positives, negatives, _ = _sets((3, 4, 4, 5), seed=2)
    is_pair = ~torch.eye(4, dtype=torch.bool).expand(3, 4, 4)

    def of(p, n):
        return triplet_loss(p, n, is_pair, 1.9)

    assert torch.autograd.gradcheck(of, (positives.requires_grad_(), negatives.requires_grad_()))


def test_identical_embeddings_have_a_finite_gradient():
    positives = torch.ones(1, 4, 3, requires_grad=True)
    negatives = torch.ones(1, 4, 3, requires_grad=True)
    partners = torch.tensor([[1, 2, 3, 0]])
    simplified_multi_constraint_loss(positives, negatives, partners, ALPHA, BETA).sum().backward()
    assert torch.isfinite(positives.grad).all()
    assert torch.isfinite(negatives.grad).all()


def test_partners_are_others_drawn_evenly_and_by_the_seed():
    partners = draw_partners(3000, 4, np.random.default_rng(3))
    assert (partners != np.arange(4)).all()
    counts = np.bincount(partners[:, 0], minlength=4)
    assert counts[0] == 0
    assert counts[1:].min() > 850
    np.testing.assert_array_equal(partners, draw_partners(3000, 4, np.random.default_rng(3)))


def test_single_negative_has_no_partner():
    with pytest.raises(ValueError, match="needs two"):
        draw_partners(1, 1, np.random.default_rng(0))
