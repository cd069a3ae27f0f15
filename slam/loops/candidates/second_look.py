# SPDX-License-Identifier: Apache-2.0
"""A second look, by cheap local evidence, at the keyframes that look like a new one."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import CheckedRecognizer
from slam.config import PYRAMID_SCALE
from slam.geometry.features import match_descriptors
from slam.types import Camera, Check, Features, FloatArray, Keyframe, RejectionReason

NEEDED = 18
"""So many features must lie as in one rigid scene. Of all pairs of keyframes that verification
accepts this loses 2.3 % on fr1_xyz and 0.8 % on the demo, on which alone it was chosen."""
_ABOVE_NOTHING = 1e-6
"""What a recognizer gives less has nothing in common."""
_ENOUGH_DEPTH = 0.3  # share of the features
_STRONG = 300
_MAX_DISTANCE = 64  # by Hamming
_PIXEL_NOISE_PX = 1.0
_STANDARD_DEVIATIONS = 1.5
_SLACK_M = 0.005
"""What lens and rolling shutter add to the noise of the distance between two points."""


class SecondLook:
    """Chooses which of the similar keyframes are worth verifying.

    The recognizer's own `rerank` is asked where it has one, for the keyframes' previews; else
    features with depth tell.
    """

    def __init__(self, camera: Camera, recognizer: CheckedRecognizer, most: int) -> None:
        """Look with one camera, unless keyframes name theirs, and choose so many at most."""
        self._camera = camera
        self._recognizer = recognizer
        self._most = most

    def choose(self, query: Keyframe, candidates: Sequence[Keyframe]) -> list[tuple[int, Check]]:
        """Return each candidate's number, the most promising first, and whether it is chosen.

        Raises:
            RecognizerError: its rerank failed.
        """
        if self._recognizer.can_rerank:
            images = [each.preview.rgb for each in candidates]
            scores, needed = self._recognizer.rerank(query.preview.rgb, images), _ABOVE_NOTHING
        else:
            ours, features = query.features, [each.features for each in candidates]
            camera, *cameras = (each.camera or self._camera for each in [query, *candidates])
            scores = rerank(ours, features, camera, cameras).astype(np.float64)
            # Where depth does not reach, little in common says little.
            has_depth = all(_share_with_depth(each) >= _ENOUGH_DEPTH for each in [*features, ours])
            needed = float(NEEDED) if has_depth else 0.0
        order = [int(k) for k in np.argsort(-scores, kind="stable")]
        chosen = [k for k in order if scores[k] >= needed][: self._most]
        if len(chosen) == self._most:  # whoever is not among them needed as much as their last
            needed = float(scores[chosen[-1]])
        reason = RejectionReason.SECOND_LOOK
        return [(k, Check(reason, float(scores[k]), needed, k in chosen)) for k in order]


def rerank(
    query: Features,
    candidates: Sequence[Features],
    camera: Camera,
    cameras: Sequence[Camera] | None = None,
) -> NDArray[np.int64]:
    """Return (C,), how many features of the query each candidate shows as in one rigid scene.

    The query's strong features are matched with all of a candidate. Two matches agree where their
    points are as far apart in one view as in the other, which depth tells without a motion. The
    count is the largest k such that k matches agree with k others each. The candidates' cameras are
    the query's unless told.
    """
    strong = strongest(query)
    of_each = [camera] * len(candidates) if cameras is None else cameras
    counts = [
        _count_rigid(query, strong, candidate, (camera, other))
        for candidate, other in zip(candidates, of_each, strict=True)
    ]
    return np.array(counts, dtype=np.int64)


def _share_with_depth(features: Features) -> float:
    has_depth = np.isfinite(features.depth_m)
    return float(has_depth.mean()) if len(has_depth) else 1.0


def strongest(features: Features) -> NDArray[np.int64]:
    """Return features with depth, of every pyramid level the same share, its first.

    Those of a `FeatureExtractor` are in the order of their strength within each level.
    """
    ids = np.flatnonzero(np.isfinite(features.depth_m))
    octaves = features.octaves[ids]
    counts = np.bincount(octaves)
    by_octave = np.argsort(octaves, kind="stable")
    rank = np.empty(len(ids))
    rank[by_octave] = np.arange(len(ids)) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.sort(ids[np.argsort(rank / counts[octaves], kind="stable")[:_STRONG]])


def agreements(
    query: Features,
    strong: NDArray[np.int64],
    candidate: Features,
    cameras: tuple[Camera, Camera],
) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return (M, 2) matches of features with depth, and (M, M) which of them agree.

    Of the query only strong ones are matched; its camera comes first. A match agrees with itself,
    too.
    """
    placed = np.flatnonzero(np.isfinite(candidate.depth_m))
    pairs = match_descriptors(
        query.descriptors[strong], candidate.descriptors[placed], _MAX_DISTANCE
    )
    ours, theirs = strong[pairs[:, 0]], placed[pairs[:, 1]]
    our_points_m, their_points_m = query.points_m[ours], candidate.points_m[theirs]
    difference_m = np.abs(_distances(our_points_m) - _distances(their_points_m))
    variance = _variance(query, ours, cameras[0]) + _variance(candidate, theirs, cameras[1])
    allowed_m = _SLACK_M + _STANDARD_DEVIATIONS * np.sqrt(variance[:, None] + variance)
    return np.column_stack([ours, theirs]), difference_m < allowed_m


def _count_rigid(
    query: Features, strong: NDArray[np.int64], candidate: Features, cameras: tuple[Camera, Camera]
) -> int:
    _, agree = agreements(query, strong, candidate, cameras)
    agreeing = np.sort(np.count_nonzero(agree, axis=1) - 1)[::-1]  # but itself
    return int(np.count_nonzero(agreeing > np.arange(len(agreeing))))


def _distances(points_m: NDArray[np.float32]) -> FloatArray:
    """Return the (N, N) distances between (N, 3) points."""
    points = points_m.astype(np.float64)  # squares cancel
    squares = np.einsum("ni,ni->n", points, points)
    squared = squares[:, None] + squares - 2.0 * points @ points.T
    return np.asarray(np.sqrt(np.maximum(squared, 0.0)))


def _variance(features: Features, ids: NDArray[np.int64], camera: Camera) -> FloatArray:
    """Return how far (N,) points may be off, square metres, by the noise of depth and of pixels."""
    depth_m = features.depth_m[ids]
    pixel_m = _PIXEL_NOISE_PX * PYRAMID_SCALE ** features.octaves[ids] * depth_m / camera.fx
    return np.asarray((camera.depth_noise_m * depth_m**2) ** 2 + pixel_m**2)
