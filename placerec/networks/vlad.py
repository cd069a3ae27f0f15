# SPDX-License-Identifier: Apache-2.0
"""NetVLAD: how local features differ from the words that they are most like (Arandjelovic 2016)."""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor, nn
from torch.nn import functional

from placerec.recognizer import RecognizerError

RUNNER_UP = 0.01
"""Share of a feature that its second word is given, at the start and for the median feature."""
ROUNDS = 20


class Vlad(nn.Module):
    """A layer from maps to the sums of residuals to K words, by soft assignment.

    Attributes:
        conv: from (N, C, h, w) to how well each local feature fits each word, before softmax.
        centroids: (K, C), the words; named as in the published weights.
    """

    def __init__(self, words: int, channels: int) -> None:
        """Make a layer with random words, 2 or more."""
        super().__init__()
        self.conv = nn.Conv2d(channels, words, kernel_size=1)
        self.centroids = nn.Parameter(torch.rand(words, channels))

    def forward(self, maps: Tensor) -> Tensor:
        """Return the (N, K * C) residuals of (N, C, h, w) maps, of unit length per word and in all.

        Local features are brought to unit length first.
        """
        local = functional.normalize(maps.float(), dim=1)
        shares = functional.softmax(self.conv(local).flatten(start_dim=2), dim=1)
        sums = shares @ local.flatten(start_dim=2).transpose(1, 2)
        residuals = sums - shares.sum(dim=2, keepdim=True) * self.centroids
        return functional.normalize(functional.normalize(residuals, dim=2).flatten(start_dim=1))

    @torch.no_grad()
    def start(self, features: Tensor, seed: int = 0) -> None:
        """Set the words to the means of k-means among (n, C) local features of any length.

        Raises:
            RecognizerError: there are fewer features than words.
        """
        local = functional.normalize(features.float()).cpu().numpy()
        words = torch.from_numpy(find_words(local, len(self.centroids), seed))
        squares = torch.cdist(torch.from_numpy(local), words).square()
        nearest, second = squares.topk(2, largest=False).values.unbind(dim=1)
        gap = (second - nearest).median().clamp(min=torch.finfo().eps)
        sharpness = -np.log(RUNNER_UP) / gap
        # softmax(-sharpness * |x - c|^2): what all words have in common, |x|^2, cancels.
        self.centroids.copy_(words)
        self.conv.weight.copy_(2.0 * sharpness * words[:, :, None, None])
        assert self.conv.bias is not None
        self.conv.bias.copy_(-sharpness * words.square().sum(dim=1))


def find_words(features: NDArray[np.float32], count: int, seed: int) -> NDArray[np.float32]:
    """Return the (K, C) means of k-means among (n, C) features.

    Raises:
        RecognizerError: there are fewer features than words.
    """
    if len(features) < count:
        raise RecognizerError(
            f"{count} words cannot be found in {len(features)} local features; give more images"
        )
    words = _scattered(features, count, np.random.default_rng(seed))
    for _ in range(ROUNDS):
        # By |x - w|^2, of which |x|^2 is the same for all words.
        nearest = (features @ words.T - 0.5 * np.square(words).sum(axis=1)).argmax(axis=1)
        ones, rows = np.ones(len(nearest), np.float32), np.arange(len(nearest))
        members = csr_array((ones, (nearest, rows)), shape=(count, len(nearest)))
        sizes = members.sum(axis=1)[:, None]
        # A word that no feature is nearest to stays where it is.
        words = np.where(sizes > 0, (members @ features) / np.maximum(sizes, 1.0), words)
    return words.astype(np.float32)


def _scattered(
    features: NDArray[np.float32], count: int, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Return (K, C) features, each drawn by its squared distance to those before it (k-means++)."""
    chosen = [int(rng.integers(len(features)))]
    distances = np.full(len(features), np.inf)
    while len(chosen) < count:
        to_last = np.square(features - features[chosen[-1]]).sum(axis=1, dtype=np.float64)
        distances = np.minimum(distances, to_last)
        chances = np.cumsum(distances)
        drawn = np.searchsorted(chances, rng.random() * chances[-1], side="right")
        chosen.append(min(int(drawn), len(features) - 1))
    return features[chosen]
