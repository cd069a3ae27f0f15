# SPDX-License-Identifier: Apache-2.0
"""Bags of visual words: ORB, a vocabulary tree and tf-idf, scored as DBoW2 does for ORB-SLAM."""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import Embeddings, Similarities
from placerec.errors import RecognizerError
from placerec.recognizers.fitted_file import Fitted, FittedRecognizer

Descriptors = NDArray[np.uint8]

CHILDREN, DEPTH = 16, 3
"""Of the tree: 4096 words."""
CHUNK = 65536
_ROUNDS = 8
_LONGER_SIDE_PX = 640
_FEATURES = 1000
_FAST_THRESHOLD = 7
_BORDER_PX = 19
_ORB_BYTES = 32
_FEATURES_FOUND = f"{_FEATURES} ORB at {_LONGER_SIDE_PX} px, FAST from {_FAST_THRESHOLD}"
_LEAST_SIDE_PX = 2 * _BORDER_PX + 1
"""ORB sees nothing in less, and OpenCV fails where a level of its pyramid has no pixel."""


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
    nearest = VocabularyTree((middles[None],))(descriptors)
    bits = np.unpackbits(descriptors, axis=1)
    for _ in range(_ROUNDS):
        for k in np.unique(nearest):
            middles[k] = np.packbits(2 * bits[nearest == k].mean(axis=0) > 1.0)
        before, nearest = nearest, VocabularyTree((middles[None],))(descriptors)
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


def _hamming(a: Descriptors, b: Descriptors) -> NDArray[np.int64]:
    """Return the number of different bits, over the last axis, of descriptors of 8 n bytes."""
    wide = (np.ascontiguousarray(side).view(np.uint64) for side in (a, b))
    return np.asarray(np.bitwise_count(np.bitwise_xor(*wide)).sum(axis=-1, dtype=int))


class BagOfWords(FittedRecognizer):
    """How often which word is seen, weighed by how rare it is (tf-idf); DBoW2's L1 score compares.

    Attributes:
        looks_back: each image is compared on its own.
        min_similarity: kept with the vocabulary; the shipped one's is what `placerec calibrate`
            finds on the validation floors of ie_tower.
    """

    name = "bag-of-words"
    min_similarity = 0.2
    looks_back = 0

    def __init__(self, path: Path | None = None) -> None:
        super().__init__(path)
        arrays = self._fitted.arrays
        levels = [arrays[name] for name in sorted(arrays) if name != "rarity"]
        self._tree, self._rarity = VocabularyTree(tuple(levels)), arrays["rarity"]
        self.weights = f"{self._tree.words} words of {self._fitted.source}"
        # The same words once made vectors of unit length, which may still be kept somewhere.
        self.fingerprint = f"L1 of {self._fitted.fingerprint}"

    @classmethod
    def fit(cls, images: Iterable[NDArray[np.uint8]], seed: int = 0) -> Fitted:
        """Return the words that images consist of, and how rare each is.

        Raises:
            RecognizerError: nothing was seen in them.
        """
        documents = [_descriptors(image) for image in images]
        descriptors = np.concatenate([np.empty((0, _ORB_BYTES), np.uint8), *documents])
        if not len(descriptors):
            raise RecognizerError(f"no corner was found in {len(documents)} images; give others")
        tree = grow(descriptors, CHILDREN, DEPTH, np.random.default_rng(seed))
        levels = {f"level{i}": level for i, level in enumerate(tree.levels)}
        seen_in = np.zeros(tree.words)
        for document in documents:
            seen_in[np.unique(tree(document))] += 1.0
        # How much the sight of each word says: the logarithm of how rare it is (idf).
        rarity = np.log((len(documents) + 1.0) / (seen_in + 1.0)).astype(np.float32)
        return Fitted({**levels, "rarity": rarity}, {"features": _FEATURES_FOUND})

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the (W + 1,) float32 embedding of a (H, W, 3) uint8 RGB image: shares, 1 in all.

        The last value is what is left of an image in which no word is seen, and 0 in others.
        """
        words = self._tree(_descriptors(image))
        counts = np.bincount(words, minlength=self._tree.words) * self._rarity
        vector = np.append(counts, 0.0 if counts.any() else 1.0)
        return np.asarray(vector / vector.sum(), np.float32)

    def compare(self, queries: Embeddings, references: Embeddings) -> Similarities:
        """Return (Q, R) float32 scores of DBoW2, 1 - |v - w| / 2 with the L1 norm, 0 to 1."""
        similarities = np.empty((len(queries), len(references)), np.float32)
        for row, query in zip(similarities, queries, strict=True):
            # Of shares that are 1 in all this is the sum of the smaller of each two: only the words
            # of the query need to be looked at.
            seen = np.flatnonzero(query)
            shared = np.minimum(references[:, seen], query[seen])
            row[:] = shared.sum(axis=1, dtype=np.float64)
        return similarities


def _descriptors(image: NDArray[np.uint8]) -> Descriptors:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    scale = _LONGER_SIDE_PX / max(grey.shape)
    interpolation = cv2.INTER_AREA if scale < 1.0 else cv2.INTER_LINEAR
    size = [max(_LEAST_SIDE_PX, round(side * scale)) for side in reversed(grey.shape)]
    # A detector of its own for every image: it is made in no time, and threads share nothing.
    orb = cv2.ORB.create(_FEATURES, edgeThreshold=_BORDER_PX, fastThreshold=_FAST_THRESHOLD)
    _, descriptors = orb.detectAndCompute(cv2.resize(grey, size, interpolation=interpolation), None)
    none = np.empty((0, _ORB_BYTES), np.uint8)
    return none if descriptors is None else np.asarray(descriptors, np.uint8)
