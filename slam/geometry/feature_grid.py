# SPDX-License-Identifier: Apache-2.0
"""Finds known points among a frame's features: only near where they should be seen."""

import numpy as np
from numpy.typing import NDArray

from placerec.compiled import compiled, count_bits, inlined
from slam.geometry.features import words_of
from slam.types import Camera, Features, FloatArray, IntArray

_CELL_PX = 20.0
_OCTAVES_APART = 1.5


class FeatureGrid:
    """The features of one frame, sorted into the cells of a grid.

    Attributes:
        camera: what took it.
    """

    def __init__(self, features: Features, camera: Camera) -> None:
        self.camera = camera
        self._octaves = np.asarray(features.octaves, np.uint8)
        self._pixels = np.ascontiguousarray(features.undistorted_px, np.float32)
        self._words = words_of(features.descriptors)
        self._columns = int(np.ceil(camera.width / _CELL_PX))
        self._rows = int(np.ceil(camera.height / _CELL_PX))
        self._order, self._starts = _sorted_into_cells(self._pixels, self._columns, self._rows)

    def search(
        self,
        expected_px: FloatArray,
        radius_px: FloatArray,
        octaves: FloatArray,
        descriptors: NDArray[np.uint8],
        max_distance: int,
    ) -> IntArray:
        """Return (M, 2) int, pairs (point, feature) that are each other's best by Hamming distance.

        P points, with (P, 32) uint8 descriptors, are looked for within (P,) radii of (P, 2)
        undistorted pixels, each on a pyramid level close to its (P,) octave. The most alike come
        first.
        """
        pairs, distances = _search(
            self._pixels,
            self._octaves,
            self._words,
            self._order,
            self._starts,
            self._columns,
            np.ascontiguousarray(expected_px),
            np.ascontiguousarray(radius_px),
            np.ascontiguousarray(octaves),
            words_of(descriptors),
            max_distance,
        )
        return pairs[np.argsort(distances, kind="stable")]  # ties have one winner


@inlined
def _cell(pixel: float, cells: int) -> int:
    return min(max(int(np.floor(pixel / _CELL_PX)), 0), cells - 1)


@compiled
def _sorted_into_cells(
    pixels: NDArray[np.float32], columns: int, rows: int
) -> tuple[IntArray, IntArray]:
    """Return (N,) the features in the order of their cells, row by row, and where each begins."""
    cells = np.empty(len(pixels), np.int64)
    starts = np.zeros(rows * columns + 1, np.int64)
    for i in range(len(pixels)):
        cells[i] = _cell(pixels[i, 1], rows) * columns + _cell(pixels[i, 0], columns)
        starts[cells[i] + 1] += 1
    for cell in range(rows * columns):
        starts[cell + 1] += starts[cell]
    order, filled = np.empty(len(pixels), np.int64), starts.copy()
    for i in range(len(pixels)):
        order[filled[cells[i]]] = i
        filled[cells[i]] += 1
    return order, starts


@inlined
def _distance(a: NDArray[np.uint64], i: int, b: NDArray[np.uint64], j: int) -> int:
    """Return the Hamming distance of two rows."""
    distance = 0
    for word in range(a.shape[1]):
        distance += count_bits(a[i, word] ^ b[j, word])
    return distance


@compiled
def _search(
    pixels: NDArray[np.float32],
    octaves: NDArray[np.uint8],
    words: NDArray[np.uint64],
    order: IntArray,
    starts: IntArray,
    columns: int,
    expected_px: FloatArray,
    radius_px: FloatArray,
    expected_octaves: FloatArray,
    expected_words: NDArray[np.uint64],
    max_distance: int,
) -> tuple[IntArray, IntArray]:
    """Return (M, 2) pairs (point, feature) in the order of points, and how far apart they are."""
    rows = (len(starts) - 1) // columns
    points, features = len(expected_px), len(pixels)
    feature_of = np.full(points, -1, np.int64)
    distance_of = np.empty(points, np.int64)
    point_of = np.full(features, -1, np.int64)
    nearest_of = np.full(features, max_distance + 1, np.int64)
    for i in range(points):
        u, v, radius = expected_px[i, 0], expected_px[i, 1], radius_px[i]
        first, last = _cell(u - radius, columns), _cell(u + radius, columns)
        nearest = max_distance + 1
        for row in range(_cell(v - radius, rows), _cell(v + radius, rows) + 1):
            # The cells of a window that lie in one row follow each other in the sorted features.
            for k in range(starts[row * columns + first], starts[row * columns + last + 1]):
                j = order[k]
                off_u, off_v = pixels[j, 0] - u, pixels[j, 1] - v
                if not off_u * off_u + off_v * off_v <= radius * radius:  # nor what is NaN
                    continue
                if abs(octaves[j] - expected_octaves[i]) > _OCTAVES_APART:
                    continue
                distance = _distance(words, j, expected_words, i)
                if distance < nearest or (distance == nearest and j < feature_of[i]):
                    nearest, feature_of[i] = distance, j
                if distance < nearest_of[j]:
                    nearest_of[j], point_of[j] = distance, i
        distance_of[i] = nearest
    pairs, distances, count = np.empty((points, 2), np.int64), np.empty(points, np.int64), 0
    for i in range(points):
        if feature_of[i] >= 0 and point_of[feature_of[i]] == i:
            pairs[count, 0], pairs[count, 1], distances[count] = i, feature_of[i], distance_of[i]
            count += 1
    return pairs[:count], distances[:count]
