# SPDX-License-Identifier: Apache-2.0
"""A fully connected layer that starts where it already works: at principal components."""

import torch
from torch import Tensor
from torch.nn import functional

from placerec.networks.place_network import PlaceNetwork
from placerec.networks.pooling import WhitenedLinear

_EVENNESS = 0.01
"""Share of the mean variance that is added to each: directions that hardly vary stay weak."""
_COMPONENTS = 768
"""Directions kept at most, or as many as an embedding has values."""


def whiten(network: PlaceNetwork, values: Tensor, seed: int = 0) -> None:
    """Set a network's fully connected layer to a whitened one that starts as the identity.

    Embeddings then start as the principal components of the maps, strongest first, each as strong
    as the others: whitened principal component analysis, which tells places apart well already.
    Where an embedding has more values than there are components, the rest are random mixtures.

    Args:
        network: what to change; `merge` makes one matrix of the layer again.
        values: (n, F) float32, flattened maps of n training images (`PlaceNetwork.flatten`).
        seed: what the mixtures come from.
    """
    mean, whitening = whitened_components(values, max(_COMPONENTS, network.dimension))
    layer = WhitenedLinear(values.shape[1], len(whitening), network.dimension)
    with torch.no_grad():
        layer.whitening.copy_(whitening)
        layer.mean.copy_(mean)
        layer.weight.copy_(torch.eye(*layer.weight.shape))
        surplus = layer.weight[len(whitening) :]
        random = torch.Generator().manual_seed(seed)
        surplus.copy_(torch.randn(surplus.shape, generator=random) / len(whitening) ** 0.5)
    network.fully_connected = layer.to(values.device)


def merge(network: PlaceNetwork) -> None:
    """Make one matrix of a network's fully connected layer; nothing changes where it is one."""
    if isinstance(layer := network.fully_connected, WhitenedLinear):
        network.fully_connected = layer.merged().to(layer.weight.device)


def whitened_components(values: Tensor, at_most: int) -> tuple[Tensor, Tensor]:
    """Return the (F,) float64 mean of (n, F) values, and the (r, F) whitening of what is left.

    Along its rows, the principal components of most variance first, all values vary alike.
    """
    mean = values.double().mean(dim=0)
    directions, variances = principal_components(values.double() - mean, at_most)
    strength = (variances + _EVENNESS * variances.mean().clamp(min=torch.finfo().tiny)).rsqrt()
    return mean, strength[:, None] * directions


def principal_components(centred: Tensor, at_most: int) -> tuple[Tensor, Tensor]:
    """Return (r, F) orthonormal directions of (n, F) centred values, and their (r,) variances.

    The strongest come first.
    """
    is_wide = centred.shape[1] > len(centred)  # By the smaller of the two products.
    product = centred @ centred.T if is_wide else centred.T @ centred
    squares, vectors = torch.linalg.eigh(product)
    kept = slice(-min(at_most, len(squares)), None)
    squares, vectors = squares[kept].flip(0).clamp(min=0.0), vectors[:, kept].flip(1)
    rows = (centred.T @ vectors).T if is_wide else vectors.T
    return functional.normalize(rows), squares / len(centred)
