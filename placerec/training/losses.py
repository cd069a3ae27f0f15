# SPDX-License-Identifier: Apache-2.0
"""The triplet loss (eq. 2) and the multi-constraint loss in both its forms (eq. 6 and 7).

Embeddings come as sets: `positives` (S, A, D), A images of one place, and `negatives` (S, B, D), B
images of B other places, for S sets at once, unit length along D. Distances are squared Euclidean.
A set's centre is the mean of its positives, not of unit length (eq. 3).

`alpha` is the margin between positives and negatives; `beta`, the one between the positives' spread
and the negatives' distance from each other. `partners` (S, B) int64 are, for each negative j,
another one of its set, x_* (`draw_partners`).
"""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor


def triplet_loss(positives: Tensor, negatives: Tensor, is_pair: Tensor, alpha: float) -> Tensor:
    """Return the (S,) mean triplet loss over the triplets that each set holds (eq. 2).

    `is_pair` (S, A, A) bool says whether two positives are different images: an image may stand in
    a set twice, and is then no anchor of itself. A set without a pair has loss zero.
    """
    anchors = positives[:, :, None, None]
    near = _squared_distance(anchors, positives[:, None, :, None])
    far = _squared_distance(anchors, negatives[:, None, None])
    losses = torch.relu(near + alpha - far).mean(dim=3)
    count = is_pair.sum(dim=(1, 2)).clamp(min=1)
    return (losses * is_pair).sum(dim=(1, 2)) / count


def multi_constraint_loss(
    positives: Tensor, negatives: Tensor, partners: Tensor, alpha: float, beta: float
) -> Tensor:
    """Return the (S,) multi-constraint loss of each set, the mean over all i and j (eq. 6)."""
    centre = positives.mean(dim=1, keepdim=True)
    spread = _squared_distance(positives, centre)[:, :, None]
    reach = _squared_distance(negatives, centre)[:, None]
    apart = _squared_distance(negatives, _pick(negatives, partners))[:, None]
    constraints = torch.relu(spread + alpha - reach) + torch.relu(spread + beta - apart)
    return constraints.mean(dim=(1, 2))


def simplified_multi_constraint_loss(
    positives: Tensor, negatives: Tensor, partners: Tensor, alpha: float, beta: float
) -> Tensor:
    """Return the (S,) loss of each set's farthest positive and nearest negative alone (eq. 7).

    Of the partners, the nearest negative's counts.
    """
    centre = positives.mean(dim=1, keepdim=True)
    farthest = _squared_distance(positives, centre).amax(dim=1)
    reach = _squared_distance(negatives, centre)
    nearest = reach.argmin(dim=1, keepdim=True)
    nearest_negative = _pick(negatives, nearest)
    other_negative = _pick(negatives, partners.gather(1, nearest))
    apart = _squared_distance(nearest_negative, other_negative)[:, 0]
    return torch.relu(farthest + alpha - reach.gather(1, nearest)[:, 0]) + torch.relu(
        farthest + beta - apart
    )


def draw_partners(sets: int, negatives: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Return (S, B) int64: for each negative of each set another one of it, drawn at random.

    Raises:
        ValueError: a set has fewer than two negatives.
    """
    if negatives < 2:
        raise ValueError(f"negatives = {negatives}: a set needs two for one to have a partner")
    step = rng.integers(1, negatives, size=(sets, negatives))
    return (np.arange(negatives) + step) % negatives


def _squared_distance(a: Tensor, b: Tensor) -> Tensor:
    return (a - b).square().sum(dim=-1)


def _pick(embeddings: Tensor, indices: Tensor) -> Tensor:
    """Return the (S, K, D) rows that (S, K) indices name in each set's (S, B, D) embeddings."""
    return embeddings.gather(1, indices[:, :, None].expand(-1, -1, embeddings.shape[2]))
