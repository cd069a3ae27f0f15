# SPDX-License-Identifier: Apache-2.0
"""ORB features with depth: found in one image, matched between two."""

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam.config import PYRAMID_SCALE, FeaturesConfig
from slam.types import Camera, Features, FloatArray, Frame


def straightened(features: Features, camera: Camera, velocity: FloatArray) -> Features:
    """Return the features where the camera saw them from its place at the middle row.

    A row that is read out later was seen from where the camera had moved on to, by its velocity:
    (6,) tangent per second in its own frame, rotation first. What has no depth is turned alone.
    """
    if camera.readout_s == 0.0 or not velocity.any():
        return features
    time_s = camera.readout_s * ((features.pixels[:, 1] + 0.5) / camera.height - 0.5)
    has_depth = np.isfinite(features.depth_m)
    rays = (features.undistorted_px - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    points_m = np.column_stack([rays, np.ones(len(rays))])
    points_m *= np.where(has_depth, features.depth_m, 1.0)[:, None]
    points_m = Rotation.from_rotvec(time_s[:, None] * velocity[:3]).apply(points_m)
    points_m += (has_depth * time_s)[:, None] * velocity[3:]
    pixels = points_m[:, :2] / points_m[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
    unknown = np.where(has_depth, 1.0, np.nan)[:, None]
    return replace(
        features,
        undistorted_px=pixels,
        depth_m=points_m[:, 2] * unknown[:, 0],
        points_m=points_m * unknown,
    )


_BORDER_PX = 19  # ORB's patch does not fit closer to the image border


class FeatureExtractor:
    """Finds ORB features spread over the image and places those with depth in space."""

    def __init__(self, camera: Camera, config: FeaturesConfig) -> None:
        self._camera = camera
        self._config = config
        # On a smaller level no feature fits, and OpenCV fails where it has no pixel at all.
        patches = min(camera.width, camera.height) / (2 * _BORDER_PX + 1)
        most_levels = 1 + int(np.log(max(patches, 1.0)) / np.log(PYRAMID_SCALE))
        # More corners than wanted, so that the spreading below has something to choose from.
        self._orb = cv2.ORB.create(
            nfeatures=2 * config.count,
            scaleFactor=PYRAMID_SCALE,
            nlevels=min(config.levels, most_levels),
            edgeThreshold=_BORDER_PX,
            fastThreshold=config.fast_threshold,
        )

    def extract(self, frame: Frame) -> Features:
        """Return the frame's features; there may be none in a blank image."""
        grey = cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY)
        keypoints = self._orb.detect(grey, None)
        keypoints = [keypoints[i] for i in _spread(keypoints, self._config.count)]
        keypoints, descriptors = self._orb.compute(grey, keypoints)
        if descriptors is None:
            keypoints, descriptors = [], np.zeros((0, 32))
        pixels = _pixels(keypoints)
        undistorted_px = undistort(pixels, self._camera)
        u, v = np.rint(pixels).astype(np.int64).T
        depth_m = frame.depth_m[v, u].astype(np.float64)
        depth_m = np.where((depth_m > 0.0) & np.isfinite(depth_m), depth_m, np.nan)
        return Features(
            pixels=pixels,
            undistorted_px=undistorted_px,
            octaves=np.array([k.octave for k in keypoints], dtype=np.int64),
            descriptors=np.asarray(descriptors, dtype=np.uint8),
            depth_m=depth_m,
            points_m=back_project(undistorted_px, depth_m, self._camera),
        )


def match(a: Features, b: Features, max_distance: int) -> NDArray[np.int64]:
    """Return (M, 2) int, index pairs of features that are each other's nearest by Hamming."""
    return match_descriptors(a.descriptors, b.descriptors, max_distance)


def match_descriptors(
    a: NDArray[np.uint8], b: NDArray[np.uint8], max_distance: int
) -> NDArray[np.int64]:
    """Return the same of (N, 32) and (K, 32) descriptors."""
    if len(a) == 0 or len(b) == 0:
        return np.zeros((0, 2), dtype=np.int64)
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, crossCheck=True).match(a, b)
    pairs = [(m.queryIdx, m.trainIdx) for m in matches if m.distance <= max_distance]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def undistort(pixels: FloatArray, camera: Camera) -> FloatArray:
    """Return (N, 2) pixels as an ideal pinhole camera would have seen them."""
    if len(pixels) == 0 or not any(camera.distortion):
        return pixels.copy()
    coefficients = np.array(camera.distortion)
    K = camera.matrix
    undistorted = cv2.undistortPoints(pixels.reshape(-1, 1, 2), K, coefficients, P=K)
    return np.asarray(undistorted, dtype=np.float64).reshape(-1, 2)


def back_project(undistorted_px: FloatArray, depth_m: FloatArray, camera: Camera) -> FloatArray:
    """Return (N, 3) points, metres, camera frame, of (N, 2) undistorted pixels and (N,) depths."""
    x = (undistorted_px[:, 0] - camera.cx) / camera.fx
    y = (undistorted_px[:, 1] - camera.cy) / camera.fy
    return np.stack([x * depth_m, y * depth_m, depth_m], axis=1)


def _pixels(keypoints: Any) -> FloatArray:
    return np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float64).reshape(-1, 2)


def _spread(keypoints: Any, count: int) -> NDArray[np.int64]:
    # The strongest corners crowd on a few objects, and a pose is only as good as its support is
    # wide: every cell of a grid offers its best first, then its second best, and so on.
    if len(keypoints) <= count:
        return np.arange(len(keypoints))
    cell_px = 40
    column, row = (_pixels(keypoints) // cell_px).T
    cells = 1000 * row + column
    strength = np.array([k.response for k in keypoints])
    by_cell = np.lexsort((-strength, cells))
    sorted_cells = cells[by_cell]
    first_of_cell = np.searchsorted(sorted_cells, sorted_cells, side="left")
    rank_in_cell = np.empty(len(cells), dtype=np.int64)
    rank_in_cell[by_cell] = np.arange(len(cells)) - first_of_cell
    return np.lexsort((-strength, rank_in_cell))[:count]
