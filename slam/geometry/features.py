# SPDX-License-Identifier: Apache-2.0
"""ORB features with depth: found in one image, matched between two."""

from dataclasses import replace
from typing import Any, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.compiled import compiled, count_bits, inlined
from slam.config import PYRAMID_SCALE, FeaturesConfig
from slam.geometry.reprojection import pinhole
from slam.types import Camera, Features, FloatArray, IntArray


def straightened(features: Features, camera: Camera, velocity: FloatArray) -> Features:
    """Return the features where the camera saw them from its place at the middle row.

    A row that is read out later was seen from where the camera had moved on to, by its velocity:
    (6,) tangent per second in its own frame, rotation first. What has no depth is turned alone.
    """
    if camera.readout_s == 0.0 or not velocity.any():
        return features
    time_s = camera.readout_s * ((features.pixels[:, 1] + 0.5) / camera.height - 0.5)
    points_m, undistorted_px, depth_m = _moved(
        np.asarray(features.undistorted_px, np.float64),
        np.asarray(features.depth_m, np.float64),
        np.asarray(time_s, np.float64),
        np.asarray(velocity, np.float64),
        pinhole(camera),
    )
    return replace(
        features,
        undistorted_px=undistorted_px.astype(np.float32),
        depth_m=depth_m.astype(np.float32),
        points_m=points_m.astype(np.float32),
    )


@compiled
def _moved(
    pixels: FloatArray,
    depth_m: FloatArray,
    time_s: FloatArray,
    velocity: FloatArray,
    intrinsics: tuple[float, float, float, float],
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (N, 3) points, (N, 2) pixels and (N,) depths after (N,) times at a (6,) velocity."""
    fx, fy, cx, cy = intrinsics
    points_m, moved_px = np.empty((len(pixels), 3)), np.empty((len(pixels), 2))
    moved_m = np.empty(len(pixels))
    speed = np.sqrt(velocity[0] ** 2 + velocity[1] ** 2 + velocity[2] ** 2)
    slowest = max(speed, 1e-300)
    axis = (velocity[0] / slowest, velocity[1] / slowest, velocity[2] / slowest)
    for i in range(len(pixels)):
        has_depth = np.isfinite(depth_m[i])
        z = depth_m[i] if has_depth else 1.0
        x, y = (pixels[i, 0] - cx) / fx * z, (pixels[i, 1] - cy) / fy * z
        sine, cosine = np.sin(speed * time_s[i]), np.cos(speed * time_s[i])
        along = (axis[0] * x + axis[1] * y + axis[2] * z) * (1.0 - cosine)
        turned_x = x * cosine + (axis[1] * z - axis[2] * y) * sine + axis[0] * along
        turned_y = y * cosine + (axis[2] * x - axis[0] * z) * sine + axis[1] * along
        turned_z = z * cosine + (axis[0] * y - axis[1] * x) * sine + axis[2] * along
        if has_depth:
            turned_x += time_s[i] * velocity[3]
            turned_y += time_s[i] * velocity[4]
            turned_z += time_s[i] * velocity[5]
        moved_px[i, 0] = fx * turned_x / turned_z + cx
        moved_px[i, 1] = fy * turned_y / turned_z + cy
        unknown = 0.0 if has_depth else np.nan
        points_m[i, 0], points_m[i, 1] = turned_x + unknown, turned_y + unknown
        points_m[i, 2] = moved_m[i] = turned_z + unknown
    return points_m, moved_px, moved_m


_BORDER_PX = 19  # ORB's patch does not fit closer to the image border


def search_images_on_one_thread() -> None:
    """Let OpenCV start no threads in this process: a pipeline keeps two cores busy with its own.

    An image takes a sixth less work so, and the features are the same.
    """
    cv2.setNumThreads(1)


def grey_of(rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the (H, W) brightness of a (H, W, 3) image."""
    return np.asarray(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), np.uint8)


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

    def extract(self, grey: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> Features:
        """Return the features of a (H, W) image with depth in metres; a blank one may have none."""
        keypoints, descriptors = self._orb.detectAndCompute(grey, None)
        pixels, octaves = _pixels(keypoints), np.array([k.octave for k in keypoints], np.uint8)
        if descriptors is None:
            descriptors = np.zeros((0, 32), np.uint8)
        strength = np.array([k.response for k in keypoints], np.float32)
        chosen = _spread(pixels, strength, self._config.count)
        chosen = chosen[np.argsort(octaves[chosen], kind="stable")]
        pixels = pixels[chosen]
        undistorted_px = undistort(pixels, self._camera)
        u, v = np.rint(pixels).astype(np.int64).T
        depth_m = depth_m[v, u]
        depth_m[~((depth_m > 0.0) & np.isfinite(depth_m))] = np.nan
        return Features(
            pixels=pixels,
            undistorted_px=undistorted_px,
            octaves=octaves[chosen],
            descriptors=np.asarray(descriptors[chosen], np.uint8),
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
    return _mutual_nearest(words_of(a), np.ascontiguousarray(words_of(b).T), max_distance)


def words_of(descriptors: NDArray[np.uint8]) -> NDArray[np.uint64]:
    """Return (N, W) words of (N, 8 W) descriptors, whose bits are counted eight bytes at a time."""
    return np.ascontiguousarray(descriptors).view(np.uint64)


@inlined
def _measure(
    a: NDArray[np.uint64], i: int, b: NDArray[np.uint64], distances: NDArray[np.int64]
) -> None:
    """Set the (K,) Hamming distances of row i of (N, W) words to the columns of (W, K)."""
    for j in range(len(distances)):
        distances[j] = 0
    for word in range(len(b)):  # the inner loop runs over all others at once
        for j in range(len(distances)):
            distances[j] += count_bits(a[i, word] ^ b[word, j])


@compiled
def _mutual_nearest(a: NDArray[np.uint64], b: NDArray[np.uint64], max_distance: int) -> IntArray:
    """Return the pairs of (N, W) and (W, K) words; of equally near ones the first is nearest."""
    words, others = b.shape
    nearest_of_b, a_of_b = np.full(others, 64 * words + 1, np.int64), np.zeros(others, np.int64)
    b_of_a, distances = np.zeros(len(a), np.int64), np.empty(others, np.int64)
    for i in range(len(a)):
        _measure(a, i, b, distances)
        nearest = 64 * words + 1
        for j in range(others):
            if distances[j] < nearest:
                nearest, b_of_a[i] = distances[j], j
        for j in range(others):
            if distances[j] < nearest_of_b[j]:
                nearest_of_b[j], a_of_b[j] = distances[j], i
    pairs, count = np.empty((len(a), 2), np.int64), 0
    for i in range(len(a)):
        if a_of_b[b_of_a[i]] == i and nearest_of_b[b_of_a[i]] <= max_distance:
            pairs[count, 0], pairs[count, 1] = i, b_of_a[i]
            count += 1
    return pairs[:count]


_Array = TypeVar("_Array", NDArray[np.float32], FloatArray)


def undistort(pixels: _Array, camera: Camera) -> _Array:
    """Return (N, 2) pixels as an ideal pinhole camera would have seen them."""
    if len(pixels) == 0 or not any(camera.distortion):
        return pixels.copy()
    coefficients = np.array(camera.distortion)
    K = camera.matrix
    undistorted = cv2.undistortPoints(pixels.reshape(-1, 1, 2), K, coefficients, P=K)
    return np.asarray(undistorted, dtype=pixels.dtype).reshape(-1, 2)


def distort(undistorted_px: _Array, camera: Camera) -> _Array:
    """Return (N, 2) pixels where the camera shows what an ideal pinhole camera sees at others."""
    if len(undistorted_px) == 0 or not any(camera.distortion):
        return undistorted_px.copy()
    ones = np.ones(len(undistorted_px))
    rays = back_project(undistorted_px.astype(np.float64), ones, camera)
    coefficients, still = np.array(camera.distortion), np.zeros(3)
    pixels, _ = cv2.projectPoints(rays, still, still, camera.matrix, coefficients)
    return np.asarray(pixels, dtype=undistorted_px.dtype).reshape(-1, 2)


def back_project(undistorted_px: _Array, depth_m: _Array, camera: Camera) -> _Array:
    """Return (N, 3) points, metres, camera frame, of (N, 2) undistorted pixels and (N,) depths."""
    x = (undistorted_px[:, 0] - camera.cx) / camera.fx
    y = (undistorted_px[:, 1] - camera.cy) / camera.fy
    return np.stack([x * depth_m, y * depth_m, depth_m], axis=1)


def _pixels(keypoints: Any) -> NDArray[np.float32]:
    return np.asarray(cv2.KeyPoint.convert(keypoints), dtype=np.float32).reshape(-1, 2)


def _spread(
    pixels: NDArray[np.float32], strength: NDArray[np.float32], count: int
) -> NDArray[np.int64]:
    # The strongest corners crowd on a few objects, and a pose is only as good as its support is
    # wide: every cell of a grid offers its best first, then its second best, and so on.
    if len(pixels) <= count:
        return np.arange(len(pixels))
    strongest_first = np.argsort(-strength, kind="stable")
    cells = (pixels[strongest_first] // _SPREAD_PX).astype(np.int64)
    rank = _rank_in_cell(cells[:, 1] * (cells[:, 0].max() + 1) + cells[:, 0])
    return strongest_first[np.argsort(rank, kind="stable")[:count]]


_SPREAD_PX = 40


@compiled
def _rank_in_cell(cells: IntArray) -> IntArray:
    """Return how many of (N,) small numbers that are the same come before each."""
    last = np.int64(0)
    for cell in cells:
        last = max(last, cell)
    taken, rank = np.zeros(last + 1, np.int64), np.empty(len(cells), np.int64)
    for i in range(len(cells)):
        rank[i] = taken[cells[i]]
        taken[cells[i]] += 1
    return rank
