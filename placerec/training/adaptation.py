# SPDX-License-Identifier: Apache-2.0
"""The last layer of a network, adapted to one environment by pairs of its images.

Algorithm 1 wants four negatives of a set to be apart from each other and from all its positives. A
recording of one desk has no such sets, but many pairs of images of one place, and of places just
beyond each other. What changes within a place there is to count less, and what changes just beyond
it more: the two sides of the paper's constraints (eq. 7), met by a formula instead of steps.
"""

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from placerec.networks import PlaceNetwork

FloatMatrix = NDArray[np.float64]

WITHIN, BEYOND = 50.0, 100.0
"""Of a direction, how many times the mean of all its spread must be for squared distances along it
to be halved, or doubled. Where a recording shows little, a network stays nearly what it is."""


def spread_of(embeddings: NDArray[np.float32], pairs: NDArray[np.bool_]) -> FloatMatrix:
    """Return the (D, D) mean of (x - y)(x - y)^T over pairs of n images; zero where there are none.

    Args:
        embeddings: (n, D) of the images.
        pairs: (n, n) symmetric, those that count.
    """
    weights = pairs.astype(np.float64)
    vectors = embeddings.astype(np.float64)
    # The sum over pairs, without going through them: that of a graph's Laplacian.
    sums = weights.sum(axis=1)[:, None] * vectors - weights @ vectors
    return np.asarray(2.0 * vectors.T @ sums / max(1.0, weights.sum()))


def adapt_last_layer(
    network: PlaceNetwork, within: Sequence[FloatMatrix], beyond: Sequence[FloatMatrix]
) -> None:
    """Weigh the directions of a network's embeddings by what they tell in an environment.

    Along a direction in which embeddings spread s times as far as on average, they are divided by
    sqrt(1 + s / WITHIN) for the spread within a place; then multiplied by sqrt(1 + s / BEYOND) for
    what is left of the spread to just beyond it.

    Args:
        network: whose fully connected layer is one matrix; it is changed.
        within: (D, D) spread over pairs of one place, of one or more recordings, which all count
            the same.
        beyond: the same over pairs of places just beyond each other.
    """
    turned = _weighed(_mean(within), -0.5, WITHIN)
    turned = _weighed(turned @ _mean(beyond) @ turned, 0.5, BEYOND) @ turned
    layer, factor = network.fully_connected, torch.from_numpy(turned)
    with torch.no_grad():
        layer.weight.copy_(factor @ layer.weight.cpu().double())
        layer.bias.copy_(factor @ layer.bias.cpu().double())


def _mean(spreads: Sequence[FloatMatrix]) -> FloatMatrix:
    return np.asarray(np.mean([_even(spread) for spread in spreads], axis=0))


def _even(spread: FloatMatrix) -> FloatMatrix:
    """Return a spread in means of all directions; one that is nothing stays that."""
    mean = np.trace(spread) / len(spread)
    return spread / mean if mean > 0.0 else spread


def _weighed(spread: FloatMatrix, power: float, strength: float) -> FloatMatrix:
    """Return the (D, D) matrix that scales each direction by (1 + s / strength) ** power."""
    times, directions = np.linalg.eigh(_even(spread))
    scales = (1.0 + np.maximum(times, 0.0) / strength) ** power
    return np.asarray((directions * scales) @ directions.T)
