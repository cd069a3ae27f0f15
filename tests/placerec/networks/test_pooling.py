# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

from placerec.errors import RecognizerError
from placerec.networks.pooling import (
    FAINT,
    POSITION_WEIGHT,
    RUNNER_UP,
    Covariance,
    Vlad,
    WhitenedLinear,
    find_words,
)


def naive_vlad(layer, maps):
    """Add residuals up one local feature and one word at a time."""
    words = layer.centroids.detach().double().numpy()
    weight = layer.conv.weight.detach().double().numpy()[:, :, 0, 0]
    bias = layer.conv.bias.detach().double().numpy()
    rows = []
    for image in maps.double().numpy():
        residuals = np.zeros_like(words)
        for feature in image.reshape(len(image), -1).T:
            x = feature / np.linalg.norm(feature)
            scores = np.exp(weight @ x + bias)
            for k, word in enumerate(words):
                residuals[k] += scores[k] / scores.sum() * (x - word)
        residuals /= np.linalg.norm(residuals, axis=1, keepdims=True)
        rows.append(residuals.ravel() / np.linalg.norm(residuals))
    return np.array(rows)


def test_residuals_are_those_added_up_by_hand():
    torch.manual_seed(0)
    layer, maps = Vlad(4, 6), torch.randn(3, 6, 2, 5)
    np.testing.assert_allclose(layer(maps).detach().numpy(), naive_vlad(layer, maps), atol=1e-5)


def test_a_tiny_case():
    # Words (1, 0) and (0, 1), so sharp that shares are 0 or 1; three features, two of the first.
    layer = Vlad(2, 2)
    with torch.no_grad():
        layer.centroids.copy_(torch.eye(2))
        layer.conv.weight.copy_(1000.0 * torch.eye(2)[:, :, None, None])
        layer.conv.bias.zero_()
    maps = torch.tensor([[[[0.8, 0.8, 0.0]], [[0.6, -0.6, 5.0]]]])  # (1, 2, 1, 3)
    # The first word: (-0.2, 0.6) + (-0.2, -0.6) = (-0.4, 0); the second: (0, 0).
    np.testing.assert_allclose(layer(maps).detach().numpy(), [[-1, 0, 0, 0]], atol=1e-6)


def test_maps_of_nothing_are_finite():
    assert torch.isfinite(Vlad(3, 4)(torch.zeros(1, 4, 2, 2))).all()


def test_it_starts_at_the_words_of_the_features_and_gives_the_runner_up_little():
    torch.manual_seed(0)
    angles = torch.cat([0.02 * torch.randn(50) + middle for middle in (0.0, 1.0, 2.5)])
    features = torch.stack([angles.cos(), angles.sin()], dim=1) * torch.rand(150, 1).add(0.1)
    layer = Vlad(3, 2)
    layer.start(features)
    found = np.sort(np.arctan2(*layer.centroids.detach().numpy().T[::-1]))
    np.testing.assert_allclose(found, [0.0, 1.0, 2.5], atol=0.02)
    maps = torch.nn.functional.normalize(features).T[None, :, :, None]
    shares = torch.softmax(layer.conv(maps)[0, :, :, 0], dim=0).detach()
    distances = torch.cdist(features / features.norm(dim=1, keepdim=True), layer.centroids)
    assert (shares.argmax(dim=0) == distances.argmin(dim=1)).all()
    second = shares.sort(dim=0).values[-2]
    assert second.median() == pytest.approx(RUNNER_UP, rel=0.05)


def test_words_by_hand():
    features = np.array([[0.0], [0.2], [5.0], [5.4]], np.float32)
    words = np.sort(find_words(features, 2, seed=0).ravel())
    np.testing.assert_allclose(words, [0.1, 5.2], rtol=1e-6)
    again = find_words(features, 2, seed=0)
    np.testing.assert_array_equal(np.sort(again.ravel()), words)


def test_words_need_features():
    with pytest.raises(RecognizerError, match="5 words cannot be found in 4 local features"):
        find_words(np.eye(4, dtype=np.float32), 5, seed=0)


def test_it_learns():
    torch.manual_seed(0)
    layer, maps = Vlad(4, 6), torch.randn(2, 6, 3, 3)
    loss = (layer(maps)[0] * layer(maps)[1]).sum()
    loss.backward()
    for parameter in layer.parameters():
        assert parameter.grad.abs().max() > 0.0


def _maps(seed=0, shape=(2, 3, 4, 5)):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_covariance_is_the_rooted_covariance_of_channels_and_position():
    maps = _maps()
    rows, columns = np.meshgrid(
        *(POSITION_WEIGHT * np.linspace(-1, 1, size) for size in (4, 5)), indexing="ij"
    )
    found = Covariance()(maps)
    for image, values in zip(maps.numpy(), found.numpy(), strict=True):
        channels = np.stack([*image, rows, columns]).reshape(5, -1)
        expected = np.cov(channels, bias=True)
        expected = np.sign(expected) * (np.sqrt(np.abs(expected) + FAINT) - np.sqrt(FAINT))
        np.testing.assert_allclose(values, expected[np.triu_indices(5)], atol=1e-5)


def test_what_is_elsewhere_changes_of_the_covariance_only_the_shares_of_position():
    maps = _maps(shape=(1, 3, 4, 5))
    moved = maps.roll((1, 2), dims=(2, 3))
    rows, columns = torch.triu_indices(5, 5)
    is_of_channels = (rows < 3) & (columns < 3)
    difference = (Covariance()(moved) - Covariance()(maps))[0].abs()
    assert difference[is_of_channels].max() < 1e-5
    assert difference[~is_of_channels].max() > 0.01


def test_gradient_of_the_covariance_is_finite_where_nothing_varies():
    maps = torch.zeros(1, 2, 3, 3, requires_grad=True)
    Covariance()(maps).sum().backward()
    assert torch.isfinite(maps.grad).all()


def test_whitened_linear_sees_its_input_centred_and_whitened():
    layer = WhitenedLinear(3, 2, 1)
    with torch.no_grad():
        layer.mean.copy_(torch.tensor([1.0, 2.0, 3.0]))
        layer.whitening.copy_(torch.tensor([[2.0, 0.0, 0.0], [0.0, 0.0, 0.5]]))
        layer.weight.copy_(torch.tensor([[10.0, 100.0]]))
        layer.bias.copy_(torch.tensor([7.0]))
    values = torch.tensor([[2.0, 9.0, 5.0]])  # centred (1, 7, 2), white (2, 1)
    assert layer(values).item() == 10 * 2 + 100 * 1 + 7
    torch.testing.assert_close(layer.merged()(values), layer(values))
