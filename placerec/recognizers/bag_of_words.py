# SPDX-License-Identifier: Apache-2.0
"""Bags of visual words: ORB, a vocabulary tree and tf-idf, which is what ORB-SLAM uses."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.certificate import Certificate, certificate_beside
from placerec.errors import RecognizerError
from placerec.recognizers.fitted_file import Fitted, read_fitted, shipped

Descriptors = NDArray[np.uint8]

ROUNDS = 8
CHUNK = 65536


@dataclass(frozen=True)
class VocabularyTree:
    """A tree whose every node has as many children; its leaves are the words.

    Attributes:
        levels: per level (nodes, children, B) uint8, the descriptors in the middle of each child;
            the children of child c of node n are those of node n * children + c one level below.
    """

    levels: tuple[Descriptors, ...]

    @property
    def words(self) -> int:
        """How many words there are."""
        return int(np.prod(self.levels[-1].shape[:2]))

    def __call__(self, descriptors: Descriptors) -> NDArray[np.int64]:
        """Return the (N,) words of (N, B) descriptors; of equally near children the first."""
        nodes = np.zeros(len(descriptors), np.int64)
        for level in self.levels:
            children = level.shape[1]
            for start in range(0, len(nodes), CHUNK):
                part = slice(start, start + CHUNK)
                distances = _hamming(descriptors[part, None], level[nodes[part]])
                nodes[part] = nodes[part] * children + distances.argmin(axis=1)
        return nodes


def grow(
    descriptors: Descriptors, children: int, depth: int, rng: np.random.Generator
) -> VocabularyTree:
    """Return a tree of children ** depth words of (N, B) descriptors, N > 0.

    Each node's descriptors are divided among its children by k-means++ under the Hamming
    distance: a middle has the bits that most of its descriptors have.
    """
    owners = np.zeros(len(descriptors), np.int64)
    levels = []
    for depth_so_far in range(depth):
        nodes = children**depth_so_far
        level = np.zeros((nodes, children, descriptors.shape[1]), np.uint8)
        order = np.argsort(owners, kind="stable")
        bounds = np.searchsorted(owners[order], np.arange(nodes + 1))
        for node in range(nodes):
            own = order[bounds[node] : bounds[node + 1]]
            if len(own):
                level[node], nearest = _k_majority(descriptors[own], children, rng)
                owners[own] = owners[own] * children + nearest
        levels.append(level)
    return VocabularyTree(tuple(levels))


def _k_majority(
    descriptors: Descriptors, count: int, rng: np.random.Generator
) -> tuple[Descriptors, NDArray[np.int64]]:
    """Return (count, B) middles, some of them equal where there is little to divide, and (N,)."""
    middles = _scattered(descriptors, count, rng)
    nearest = _nearest(descriptors, middles)
    bits = np.unpackbits(descriptors, axis=1)
    for _ in range(ROUNDS):
        for k in np.unique(nearest):
            middles[k] = np.packbits(2 * bits[nearest == k].mean(axis=0) > 1.0)
        before, nearest = nearest, _nearest(descriptors, middles)
        if np.array_equal(before, nearest):
            break
    return middles, nearest


def _scattered(descriptors: Descriptors, count: int, rng: np.random.Generator) -> Descriptors:
    """Return (count, B) descriptors, each drawn by its squared distance to those before it."""
    chosen = [int(rng.integers(len(descriptors)))]
    distances = _hamming(descriptors, descriptors[chosen])
    while len(chosen) < count:
        chances = np.cumsum(distances**2)
        drawn = np.searchsorted(chances, rng.random() * chances[-1], side="right")
        chosen.append(min(int(drawn), len(descriptors) - 1))
        distances = np.minimum(distances, _hamming(descriptors, descriptors[chosen[-1:]]))
    return descriptors[chosen]


def _nearest(descriptors: Descriptors, middles: Descriptors) -> NDArray[np.int64]:
    parts: Sequence[NDArray[np.int64]] = [
        _hamming(descriptors[start : start + CHUNK, None], middles).argmin(axis=1)
        for start in range(0, len(descriptors), CHUNK)
    ]
    return np.concatenate(parts)


def _hamming(a: Descriptors, b: Descriptors) -> NDArray[np.int64]:
    """Return the number of different bits, over the last axis, of descriptors of 8 n bytes."""
    wide = (np.ascontiguousarray(side).view(np.uint64) for side in (a, b))
    distances: NDArray[np.int64] = np.bitwise_count(np.bitwise_xor(*wide)).sum(axis=-1, dtype=int)
    return distances


NAME = "bag-of-words"
SHIPPED = shipped(NAME)
CHILDREN, DEPTH = 16, 3
"""Of the tree: 4096 words."""
LONGER_SIDE_PX = 640
FEATURES = 1000
FAST_THRESHOLD = 7
BORDER_PX = 19
ORB_BYTES = 32
FEATURES_FOUND = f"{FEATURES} ORB at {LONGER_SIDE_PX} px, FAST from {FAST_THRESHOLD}"
LEAST_SIDE_PX = 2 * BORDER_PX + 1
"""ORB sees nothing in less, and OpenCV fails where a level of its pyramid has no pixel."""


class BagOfWords:
    """How often which word is seen, weighed by how rare it is (tf-idf); the cosine compares.

    Attributes:
        min_similarity: kept with the vocabulary; the shipped one's is what `placerec calibrate`
            finds on the validation floors of ie_tower.
        weights, trained_on, fingerprint: of the vocabulary.
    """

    min_similarity: float = 0.2

    def __init__(self, path: Path = SHIPPED) -> None:
        """Read a vocabulary, by default the shipped one.

        Raises:
            RecognizerError: it cannot be read, or is none.
        """
        fitted = read_fitted(path, NAME)
        levels = [fitted.arrays[name] for name in sorted(fitted.arrays) if name != "rarity"]
        self._tree, self._rarity = VocabularyTree(tuple(levels)), fitted.arrays["rarity"]
        self._path = path
        self.min_similarity, self.trained_on = fitted.min_similarity, fitted.trained_on
        self.fingerprint, self.weights = (
            fitted.fingerprint,
            f"{self._tree.words} words of {fitted.source}",
        )

    @property
    def certificate(self) -> Certificate | None:
        """What min_similarity was calibrated on, where a certificate lies beside the vocabulary.

        Raises:
            RecognizerError: it cannot be read.
        """
        return certificate_beside(self._path)

    @classmethod
    def fit(cls, images: Iterable[NDArray[np.uint8]], seed: int = 0) -> Fitted:
        """Return the words that images consist of, and how rare each is.

        Raises:
            RecognizerError: nothing was seen in them.
        """
        documents = [_descriptors(image) for image in images]
        descriptors = np.concatenate([np.empty((0, ORB_BYTES), np.uint8), *documents])
        if not len(descriptors):
            raise RecognizerError(f"no corner was found in {len(documents)} images; give others")
        tree = grow(descriptors, CHILDREN, DEPTH, np.random.default_rng(seed))
        levels = {f"level{i}": level for i, level in enumerate(tree.levels)}
        rarity = _rarity([tree(document) for document in documents], tree.words)
        return Fitted({**levels, "rarity": rarity}, {"features": FEATURES_FOUND})

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the (W + 1,) float32 unit-length embedding of a (H, W, 3) uint8 RGB image.

        The last value is what is left of an image in which no word is seen, and 0 in others.
        """
        words = self._tree(_descriptors(image))
        counts = np.bincount(words, minlength=self._tree.words) * self._rarity
        vector = np.append(counts, 0.0 if counts.any() else 1.0)
        embedding: NDArray[np.float32] = (vector / np.linalg.norm(vector)).astype(np.float32)
        return embedding


def _descriptors(image: NDArray[np.uint8]) -> Descriptors:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = LONGER_SIDE_PX / max(grey.shape)
    interpolation = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    size = [max(LEAST_SIDE_PX, round(side * scale)) for side in reversed(grey.shape)]
    # A detector of its own for every image: it is made in no time, and threads share nothing.
    orb = cv2.ORB.create(FEATURES, edgeThreshold=BORDER_PX, fastThreshold=FAST_THRESHOLD)
    _, descriptors = orb.detectAndCompute(cv2.resize(grey, size, interpolation=interpolation), None)
    none = np.empty((0, ORB_BYTES), np.uint8)
    return none if descriptors is None else np.asarray(descriptors, np.uint8)


def _rarity(documents: list[NDArray[np.int64]], words: int) -> NDArray[np.float32]:
    """Return (W,) how much the sight of each word says: the logarithm of how rare it is (idf)."""
    seen_in = np.zeros(words)
    for document in documents:
        seen_in[np.unique(document)] += 1.0
    rarity: NDArray[np.float32] = np.log((len(documents) + 1.0) / (seen_in + 1.0)).astype("f4")
    return rarity
