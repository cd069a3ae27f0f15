# SPDX-License-Identifier: Apache-2.0
"""Finds known points among a frame's features: only near where they should be seen."""

import numpy as np
from numpy.typing import NDArray

from slam.types import Camera, Features, FloatArray, IntArray

_CELL_PX = 20.0


class FeatureGrid:
    """The features of one frame, sorted into the cells of a grid."""

    def __init__(self, features: Features, camera: Camera) -> None:
        self._octaves = features.octaves
        self._u, self._v = np.ascontiguousarray(features.undistorted_px.T)
        self._words = _words(features.descriptors)
        self._columns = int(np.ceil(camera.width / _CELL_PX))
        self._rows = int(np.ceil(camera.height / _CELL_PX))
        column, row = self._cell(features.undistorted_px)
        cells = row * self._columns + column
        self._order = np.argsort(cells, kind="stable")
        self._starts = np.searchsorted(
            cells[self._order], np.arange(self._rows * self._columns + 1)
        )

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
        undistorted pixels, each on a pyramid level close to its (P,) octave.
        """
        point, feature = self._near(expected_px, radius_px)
        u, v = np.ascontiguousarray(expected_px.T)
        offset_u, offset_v = self._u[feature] - u[point], self._v[feature] - v[point]
        is_near = offset_u**2 + offset_v**2 <= (radius_px**2)[point]
        is_near &= np.abs(self._octaves[feature] - octaves[point]) <= 1.5
        point, feature = point[is_near], feature[is_near]
        differing = self._words[feature] ^ _words(descriptors)[point]
        distance = np.bitwise_count(differing) @ np.ones(differing.shape[1], dtype=np.int64)
        is_alike = distance <= max_distance
        point, feature, distance = point[is_alike], feature[is_alike], distance[is_alike]
        order = np.lexsort((feature, point, distance))  # ties have one winner
        point, feature = point[order], feature[order]
        is_mutual = _is_first(point) & _is_first(feature)
        return np.column_stack([point[is_mutual], feature[is_mutual]])

    def _near(self, expected_px: FloatArray, radius_px: FloatArray) -> tuple[IntArray, IntArray]:
        """Return all pairs (point, feature) whose cells touch the search window."""
        radius = radius_px[:, None]
        first_column, first_row = self._cell(expected_px - radius)
        last_column, last_row = self._cell(expected_px + radius)
        # The cells of a window that lie in one row follow each other in the sorted features.
        point, row_in_window = _ranges(last_row - first_row + 1)
        row_start = (first_row[point] + row_in_window) * self._columns
        start = self._starts[row_start + first_column[point]]
        end = self._starts[row_start + last_column[point] + 1]
        strip, position = _ranges(end - start)
        return point[strip], self._order[start[strip] + position]

    def _cell(self, pixels: FloatArray) -> tuple[IntArray, IntArray]:
        column, row = np.floor(pixels / _CELL_PX).astype(np.int64).T
        return np.clip(column, 0, self._columns - 1), np.clip(row, 0, self._rows - 1)


def _words(descriptors: NDArray[np.uint8]) -> NDArray[np.uint64]:
    return np.ascontiguousarray(descriptors).view(np.uint64)


def _ranges(lengths: IntArray) -> tuple[IntArray, IntArray]:
    """Return, for each i and each j < lengths[i], i and j."""
    owner = np.repeat(np.arange(len(lengths)), lengths)
    starts = np.cumsum(lengths) - lengths
    return owner, np.arange(len(owner)) - starts[owner]


def _is_first(values: IntArray) -> NDArray[np.bool_]:
    """Return which of some small numbers stand where they occur for the first time."""
    places = np.arange(len(values))
    first = np.empty(values.max(initial=-1) + 1, dtype=np.int64)
    first[values[::-1]] = places[::-1]  # the last one that is written stays
    return np.asarray(first[values] == places)
