# SPDX-License-Identifier: Apache-2.0
"""A place recognizer without weights: how an image's gradients and colours vary together."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

_FloatMap = NDArray[np.floating[Any] | np.integer[Any]]  # what OpenCV says that it returns

_WORKING_SIZE_PX = (160, 120)
_GRID = (40, 30)
_SCALES = 2
_ORIENTATIONS = 4
_FAINT_GRADIENT = 3.0
_COLOUR_GAIN = 2.0
_FULL_LIGHTNESS = 100.0
_FULL_COLOUR = 20.0
_POSITION_WEIGHT = 0.5
_VARIANCE_FLOOR = 1e-3


class GradientRecognizer:
    """The covariance of simple local features over the image, on a logarithmic scale.

    Each cell of a grid is described by its gradients (by orientation and scale, in lightness and
    both colour channels), its colour and its place in the image. How these vary together over the
    image changes little with brightness and with where things stand, but a lot with what they
    are (region covariance, Tuzel et al. 2006, compared by matrix logarithms).

    Attributes:
        min_similarity: chosen, without looking at fr1_desk or corridor, to lose few true loops
            and to leave the rest to geometry. At 0.98 it keeps every pair of fr1_xyz less than
            0.6 apart (metres + radians) and 88 % of the pairs of views of one ie_tower picture
            under hand-held changes (roll to 18 deg, a shift of a fifth of the picture, zoom 1.2,
            exposure 1.4); it passes 14 % of such views of different pictures and 2 % of fr1_xyz
            against ie_tower. Within one small room nearly every pair passes: there only the
            number of candidates limits what geometry has to look at.
    """

    min_similarity: float = 0.98
    weights: str = "none: nothing in it is learned"
    fingerprint: str = "gradients, version 1"  # another one whenever the embeddings are others

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the (496,) float32 unit-length embedding of a (H, W, 3) uint8 RGB image."""
        features = _features(image)
        centred = features - features.mean(axis=1, keepdims=True)
        # Not `@`: BLAS would wake its threads for a tenth of a millisecond's work and, on a busy
        # machine, wait for them a hundred times as long.
        covariance = np.einsum("in,jn->ij", centred, centred) / features.shape[1]
        variances, axes = np.linalg.eigh(covariance)
        logarithm = (axes * np.log1p(np.maximum(variances, 0.0) / _VARIANCE_FLOOR)) @ axes.T
        rows, columns = np.triu_indices(len(logarithm))
        # An entry off the diagonal stands for two: the vector is then as long as the matrix.
        vector = logarithm[rows, columns] * np.where(rows == columns, 1.0, np.sqrt(2.0))
        return np.asarray(vector / np.linalg.norm(vector), np.float32)


def _features(image: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Return the (F, N) features of the N grid cells of a (H, W, 3) RGB image."""
    small = cv2.resize(image, _WORKING_SIZE_PX, interpolation=cv2.INTER_AREA)
    lightness, red, yellow = cv2.split(
        cv2.cvtColor(small.astype(np.float32) / 255.0, cv2.COLOR_RGB2LAB)
    )
    channels = (lightness, _COLOUR_GAIN * red, _COLOUR_GAIN * yellow)
    gradients = [m for channel in channels for m in _gradients(channel)]
    # Red, green, yellow and blue each on their own: more of one is not merely less of another.
    halves = (np.maximum(half, 0.0) for half in (red, -red, yellow, -yellow))
    colours = [np.sqrt(_to_grid(half) / _FULL_COLOUR) for half in halves]
    y, x = np.mgrid[-1 : 1 : _GRID[1] * 1j, -1 : 1 : _GRID[0] * 1j] * _POSITION_WEIGHT
    maps = [*gradients, *colours, _to_grid(lightness) / _FULL_LIGHTNESS, x, y]
    return np.stack(maps).reshape(len(maps), -1).astype(np.float64)


def _gradients(channel: _FloatMap) -> list[_FloatMap]:
    """Return one grid map per scale and orientation of a (H, W) channel's gradients."""
    maps: list[_FloatMap] = []
    for _ in range(_SCALES):
        dx = cv2.Sobel(channel, cv2.CV_32F, 1, 0)
        dy = cv2.Sobel(channel, cv2.CV_32F, 0, 1)
        strength = np.hypot(dx, dy) + 1e-3
        # A logarithm, so that a few hard edges do not outshine all the rest.
        gain = np.log1p(strength / _FAINT_GRADIENT) / strength**2
        # Twice the angle: an edge is the same edge seen from its dark and from its bright side.
        cosine, sine = gain * (dx * dx - dy * dy), gain * (2.0 * dx * dy)
        for angle in np.arange(_ORIENTATIONS) * (2.0 * np.pi / _ORIENTATIONS):
            along = float(np.cos(angle)) * cosine + float(np.sin(angle)) * sine
            maps.append(np.sqrt(_to_grid(np.maximum(along, 0.0))))
        channel = cv2.pyrDown(channel)
    return maps


def _to_grid(channel: _FloatMap) -> _FloatMap:
    return cv2.resize(channel, _GRID, interpolation=cv2.INTER_AREA)
