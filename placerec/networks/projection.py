# SPDX-License-Identifier: Apache-2.0
"""A fully connected layer that starts where it already works: at the principal components."""

import torch
from torch import Tensor

from placerec.networks.place_network import PlaceNetwork

FAINT = 1e-10


@torch.no_grad()
def start_from_principal_components(network: PlaceNetwork, values: Tensor, seed: int = 0) -> None:
    """Set the fully connected layer to keep the angles between maps, seen from their mean.

    Its rows are orthonormal: first the principal components of the given maps, strongest first,
    then random directions across them, where fewer components were seen than it has rows.

    Args:
        network: what to change.
        values: (n, F) float32, flattened maps of n training images (`PlaceNetwork.flatten`).
        seed: what the random directions come from.
    """
    values = values.double()
    mean = values.mean(dim=0)
    rows = _principal_components(values - mean)[: network.dimension]
    missing = min(network.dimension, values.shape[1]) - len(rows)
    if missing:
        rows = torch.cat([rows, _across(rows, missing, seed)])
    layer = network.fully_connected
    layer.weight.zero_()  # rows beyond the number of values stay zero
    layer.weight[: len(rows)] = rows.to(layer.weight)
    layer.bias.copy_(-(layer.weight.double() @ mean))


def _principal_components(centred: Tensor) -> Tensor:
    """Return the (r, F) orthonormal components of (n, F) values, strongest first, r < n."""
    # By the (n, n) products: there are fewer images than values in a map.
    squares, mixtures = torch.linalg.eigh(centred @ centred.T)
    is_strong = squares > FAINT * squares[-1].clamp(min=FAINT)
    rows = mixtures[:, is_strong].T.flip(0) @ centred
    return torch.nn.functional.normalize(rows)


def _across(rows: Tensor, count: int, seed: int) -> Tensor:
    """Return (count, F) random orthonormal rows at right angles to orthonormal (r, F) rows."""
    random = torch.Generator().manual_seed(seed)
    directions = torch.randn(count, rows.shape[1], generator=random).to(rows)
    directions -= directions @ rows.T @ rows
    orthonormal: Tensor = torch.linalg.qr(directions.T).Q
    return orthonormal.T
