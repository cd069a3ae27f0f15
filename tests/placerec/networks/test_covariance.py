# SPDX-License-Identifier: Apache-2.0
import numpy as np
import torch

from placerec.networks.pooling import FAINT, POSITION_WEIGHT, Covariance


def _maps(seed=0, shape=(2, 3, 4, 5)):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def test_is_the_rooted_covariance_of_channels_and_position():
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


def test_what_is_elsewhere_changes_only_the_shares_of_position():
    maps = _maps(shape=(1, 3, 4, 5))
    moved = maps.roll((1, 2), dims=(2, 3))
    rows, columns = torch.triu_indices(5, 5)
    is_of_channels = (rows < 3) & (columns < 3)
    difference = (Covariance()(moved) - Covariance()(maps))[0].abs()
    assert difference[is_of_channels].max() < 1e-5
    assert difference[~is_of_channels].max() > 0.01


def test_gradient_is_finite_where_nothing_varies():
    maps = torch.zeros(1, 2, 3, 3, requires_grad=True)
    Covariance()(maps).sum().backward()
    assert torch.isfinite(maps.grad).all()
