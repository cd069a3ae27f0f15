# SPDX-License-Identifier: Apache-2.0
"""How much of what one keyframe shows another one sees, by where a map has them."""

from collections.abc import Sequence

import numpy as np
from scipy.special import ndtr

from slam.geometry import se3
from slam.types import Camera, Features, FloatArray, IntArray

_POINTS = 64  # of a keyframe stand for what it shows
_NEAREST_M = 0.05  # that a camera sees
# Features look alike from so much nearer or further away, and from directions no further apart;
# ORB-SLAM matches them within the same bounds. From behind, a wall hides nothing but such points.
_MOST_NEARER, _MIN_COSINE = 2.0, 0.5


class ViewOverlap:
    """Predicts which views overlap by where K keyframes are and how well that is known."""

    def __init__(
        self,
        views: Sequence[Features],
        T_world_kf: FloatArray,
        off: FloatArray,
        camera: Camera,
    ) -> None:
        """Take what (K, 4, 4) poses show; (K, 6, D) tangents are draws of how far off they are."""
        self._points_m = np.array([_points_m(each) for each in views])
        self._T_world_kf, self._off, self._camera = T_world_kf, off, camera

    def of(self, query: int, matches: IntArray) -> FloatArray:
        """Return (M,) shares, 0 to 1, of what a query and each match show that both see.

        Of the two shares of a pair it is the smaller one that is to be expected: the less is known
        of where a point would be seen, the less that depends on where it should be. It is 0 of a
        keyframe without points, or whose pose is NaN.
        """
        queries = np.full(len(matches), query)
        both = [self._seen(queries, matches), self._seen(matches, queries)]
        return np.minimum(*both)

    def _seen(self, a: IntArray, b: IntArray) -> FloatArray:
        """Return (M,) shares of the points in views a that views b are expected to see."""
        camera, points_m = self._camera, self._points_m[a]
        T_b_a = se3.inverse(self._T_world_kf[b]) @ self._T_world_kf[a]
        T_a_b = se3.inverse(T_b_a)
        seen_m = points_m @ T_b_a[:, :3, :3].transpose(0, 2, 1) + T_b_a[:, None, :3, 3]
        z = np.maximum(seen_m[..., 2], _NEAREST_M)
        sigma_m = self._sigma_m(a, b, T_a_b, points_m.mean(axis=1))[:, None]
        share = np.where(seen_m[..., 2] > _NEAREST_M, 1.0, 0.0)
        sides = ((camera.fx, camera.cx, camera.width), (camera.fy, camera.cy, camera.height))
        for axis, (focal, centre, size) in enumerate(sides):
            px = focal * seen_m[..., axis] / z + centre
            sigma_px = 1.0 + focal * sigma_m / z
            share *= ndtr((size - px) / sigma_px) - ndtr(-px / sigma_px)
        rays_b_m = points_m - T_a_b[:, None, :3, 3]
        far_a_m, far_b_m = np.linalg.norm(points_m, axis=2), np.linalg.norm(rays_b_m, axis=2)
        is_alike = (points_m * rays_b_m).sum(axis=2) > _MIN_COSINE * far_a_m * far_b_m
        is_alike &= np.maximum(far_a_m, far_b_m) < _MOST_NEARER * np.minimum(far_a_m, far_b_m)
        return np.asarray(np.where(is_alike, share, 0.0).mean(axis=1))

    def _sigma_m(
        self, a: IntArray, b: IntArray, T_a_b: FloatArray, points_m: FloatArray
    ) -> FloatArray:
        """Return (M,) how well it is known where (M, 3) points of a are in b, per direction."""
        off = self._off[a] - se3.adjoint(T_a_b) @ self._off[b]
        moved_m = off[:, 3:] - se3.skew(points_m) @ off[:, :3]
        return np.asarray(np.sqrt((moved_m**2).mean(axis=(1, 2))))


def _points_m(view: Features) -> FloatArray:
    """Return (P, 3) points that a view shows, metres, camera frame; NaN if there are none."""
    points_m = view.points_m[np.isfinite(view.points_m[:, 0])].astype(np.float64)
    if not len(points_m):
        return np.full((_POINTS, 3), np.nan)
    return points_m[np.linspace(0, len(points_m) - 1, _POINTS).astype(np.int64)]
