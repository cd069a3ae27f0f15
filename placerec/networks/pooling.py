# SPDX-License-Identifier: Apache-2.0
"""Layers behind a trunk: its maps told by covariance or by words, and a whitened last layer."""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import csr_array
from torch import Tensor, nn
from torch.nn import functional

from placerec.errors import RecognizerError


class WhitenedLinear(nn.Module):
    """A fully connected layer that sees its input as white: centred, all directions as strong.

    As one matrix the layer would be `weight @ whitening`. Learning the first factor alone is what
    makes it learnable: the maps' values differ so much in strength that steps of one size on the
    whole matrix undo its weak rows long before the strong ones have moved.

    Attributes:
        weight, bias: (D, K), (D,); what is learned.
        whitening, mean: (K, F), (F,); fixed.
    """

    whitening: Tensor
    mean: Tensor

    def __init__(self, features: int, components: int, dimension: int) -> None:
        """Make a layer from F values by K whitened ones to D, all zero."""
        super().__init__()
        self.in_features, self.out_features = features, dimension
        self.weight = nn.Parameter(torch.zeros(dimension, components))
        self.bias = nn.Parameter(torch.zeros(dimension))
        self.register_buffer("whitening", torch.zeros(components, features))
        self.register_buffer("mean", torch.zeros(features))

    def forward(self, values: Tensor) -> Tensor:
        """Return (N, D) of (N, F) values."""
        white = functional.linear(values - self.mean, self.whitening)
        return functional.linear(white, self.weight, self.bias)

    def merged(self) -> nn.Linear:
        """Return the same layer as one matrix."""
        layer = nn.Linear(self.in_features, self.out_features)
        weight = self.weight.double() @ self.whitening.double()
        with torch.no_grad():
            layer.weight.copy_(weight)
            layer.bias.copy_(self.bias.double() - weight @ self.mean.double())
        return layer


POSITION_WEIGHT = 0.5
"""How far the two channels of position reach, from minus to plus."""
FAINT = 1e-4
"""Below it the root is all but linear: its slope stays finite at zero."""


class Covariance(nn.Module):
    """The signed square root of the covariance of the channels, and of them with position.

    Two views of a place from different sides show the same things elsewhere: the covariance of
    (N, C, h, w) maps changes little, while the maps themselves do. The root keeps strong
    co-occurrences from drowning the rest (bilinear pooling, Lin 2015). Position comes in as two
    more channels, so that layout counts without being everything.
    """

    def forward(self, maps: Tensor) -> Tensor:
        """Return the (N, (C + 2)(C + 3) / 2) upper triangles for (N, C, h, w) maps."""
        along = [torch.linspace(-1.0, 1.0, size, device=maps.device) for size in maps.shape[2:]]
        position = POSITION_WEIGHT * torch.stack(torch.meshgrid(*along, indexing="ij"))
        channels = torch.cat([maps.float(), position.expand(maps.shape[0], -1, -1, -1)], dim=1)
        values = channels.flatten(start_dim=2)
        values = values - values.mean(dim=2, keepdim=True)
        covariance = values @ values.transpose(1, 2) / values.shape[2]
        # Of NumPy, because as numbers they can be written to ONNX, which has no such operator.
        rows, columns = map(torch.from_numpy, np.triu_indices(channels.shape[1]))
        triangle = covariance[:, rows.to(maps.device), columns.to(maps.device)]
        rooted: Tensor = triangle.sign() * ((triangle.abs() + FAINT).sqrt() - FAINT**0.5)
        return rooted


RUNNER_UP = 0.01
"""Share of a feature that its second word is given, at the start and for the median feature."""
_ROUNDS = 20


class Vlad(nn.Module):
    """NetVLAD: from maps to the sums of residuals to K words, softly assigned (Arandjelovic 2016).

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
    for _ in range(_ROUNDS):
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
