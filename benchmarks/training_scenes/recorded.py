# SPDX-License-Identifier: Apache-2.0
"""Views of a recorded place from where its camera never was: real things, seen by exact poses.

The depth images of a recording in TUM RGB-D's format are fused by their true poses into a coloured
mesh, which is then looked at anew. What no image of the recording saw shows a photograph instead,
repeated and mirrored all around, so that nothing of the same colour tells views with gaps.
"""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import open3d as o3d
from scipy.spatial.transform import Rotation

from benchmarks.training_scenes.handheld import (
    Image,
    Views,
    as_cheap_cameras_see,
    nudged,
    path_times_s,
    swing,
)
from placerec.datasets.tum import Recording, read_recording
from placerec.datasets.tum_lists import nearest
from slam import Config, open_sequence
from slam.geometry.se3 import (
    from_quaternion,
    from_rotation_translation,
    inverse,
    pose_distance,
)
from slam.types import FloatArray

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 224, 168, 181.0
STRIDE = 2
"""Of the frames with truth every so many are fused."""
LONGEST_WAIT_S = 0.02
"""Between a frame and its true pose's; others are not fused."""
VOXEL_M, TRUNCATION_M, FARTHEST_M = 0.006, 0.03, 4.0
AHEAD_M = 1.0
"""How far before the mean camera the middle of what is looked at lies."""
REACH = np.array([0.5, 0.18, 0.35, 0.4, 0.45, 0.75, 0.35])
"""Of the target to the right, down and ahead, of the distance to it (metres), and of the camera's
pitch, yaw and roll (radians): how far places lie from the mean camera."""
PLACES, VIEWS = 90, 12
RADIUS, APART = 0.29, 0.6
"""Largest distance (eq. 10) of a view from its place, and least one of two places."""
SECONDS_APART = 4.0
LEAST_SEEN = 0.7
"""Share of an image that shows the mesh."""


class RecordedPlace:
    """A mesh made of a recording, and where its camera was on average."""

    def __init__(self, folder: Path) -> None:
        """Fuse a recording, which takes some minutes.

        Raises:
            SlamError: its images cannot be used.
            RecognizerError: its true poses cannot be used.
        """
        recording = read_recording(folder, STRIDE)
        T_world_cam = _poses(recording)
        mesh = _fuse(folder, recording, T_world_cam)
        self._colours = np.asarray(mesh.vertex_colors, np.float32)
        self._triangles = np.asarray(mesh.triangles)
        self._scene = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
        self._R_mean = Rotation.from_matrix(T_world_cam[:, :3, :3]).mean().as_matrix()
        self._middle_m = T_world_cam[:, :3, 3].mean(axis=0) + AHEAD_M * self._R_mean[:, 2]
        rows, columns = np.mgrid[:HEIGHT_PX, :WIDTH_PX]
        x = (columns - WIDTH_PX / 2 + 0.5) / FOCAL_PX
        y = (rows - HEIGHT_PX / 2 + 0.5) / FOCAL_PX
        self._rays = np.stack([x, y, np.ones_like(x)], axis=2).reshape(-1, 3)

    def aim(self, where: FloatArray) -> FloatArray:
        """Return the T_world_cam for (7,) offsets in the order of `REACH`."""
        R_world_cam = self._R_mean @ Rotation.from_rotvec(where[4:]).as_matrix()
        target_m = self._middle_m + self._R_mean @ where[:3]
        return from_rotation_translation(
            R_world_cam, target_m - (AHEAD_M + where[3]) * R_world_cam[:, 2]
        )

    def look(self, T_world_cam: FloatArray, photograph: Image) -> tuple[Image, float]:
        """Return a (H, W, 3) view before a photograph, and the share of it that shows the mesh."""
        directions = self._rays @ T_world_cam[:3, :3].T
        origins = np.broadcast_to(T_world_cam[:3, 3], directions.shape)
        rays = np.concatenate([origins, directions], axis=1).astype(np.float32)
        hit = self._scene.cast_rays(o3d.core.Tensor(rays))
        is_hit = np.isfinite(hit["t_hit"].numpy())
        corners = self._triangles[hit["primitive_ids"].numpy()[is_hit]]
        second, third = hit["primitive_uvs"].numpy()[is_hit].T
        weights = np.stack([1.0 - second - third, second, third], axis=1)
        image = _wallpaper(photograph, directions)
        image[is_hit] = 255.0 * np.einsum("pc,pcd->pd", weights, self._colours[corners])
        return np.asarray(image.reshape(HEIGHT_PX, WIDTH_PX, 3), np.uint8), float(is_hit.mean())

    def views_of_places(self, photographs: Sequence[Image], seed: int) -> Views:
        """Yield some views of each of some places; the first of each is the place itself."""
        rng = np.random.default_rng([seed, 0x5EE])
        places: list[FloatArray] = []
        number = 0
        for _ in range(40 * PLACES):
            T = self.aim(REACH * rng.uniform(-1.0, 1.0, len(REACH)))
            is_new = all(pose_distance(T, other) >= APART for other in places)
            if not is_new or self.look(T, photographs[0])[1] < LEAST_SEEN:
                continue
            places.append(T)
            for view in [T, *(nudged(T, RADIUS, rng) for _ in range(VIEWS - 1))]:
                photograph = photographs[int(rng.integers(len(photographs)))]
                image, share = self.look(view, photograph)
                if share >= LEAST_SEEN:
                    seen = as_cheap_cameras_see(image, rng)
                    yield 100.0 + number * SECONDS_APART, seen, view, len(places) - 1
                    number += 1
            if len(places) == PLACES:
                return

    def path(self, photographs: Sequence[Image], seed: int) -> Views:
        """Yield what a camera sees that is carried around, coming back now and then."""
        rng = np.random.default_rng([seed, 0x9A7])
        times_s = path_times_s()
        photograph = photographs[int(rng.integers(len(photographs)))]
        offsets = np.stack([swing(times_s, rng, reach) for reach in 0.85 * REACH], axis=1)
        for time_s, where in zip(times_s, offsets, strict=True):
            T = self.aim(where)
            image, share = self.look(T, photograph)
            if share >= LEAST_SEEN:
                yield 100.0 + time_s, as_cheap_cameras_see(image, rng), T, None


def _poses(recording: Recording) -> FloatArray:
    pairs = zip(recording.quaternions, recording.positions_m, strict=True)
    return np.array([from_rotation_translation(from_quaternion(q), t) for q, t in pairs])


def _fuse(folder: Path, recording: Recording, T_world_cam: FloatArray) -> o3d.geometry.TriangleMesh:
    sequence = open_sequence(folder, Config().input)
    camera = sequence.camera
    size = camera.width, camera.height
    lens = np.array(camera.distortion)
    straight = cv2.initUndistortRectifyMap(
        camera.matrix, lens, np.eye(3), camera.matrix, size, cv2.CV_32FC1
    )
    pinhole = o3d.camera.PinholeCameraIntrinsic(*size, camera.fx, camera.fy, camera.cx, camera.cy)
    volume = o3d.pipelines.integration.ScalableTSDFVolume(
        voxel_length=VOXEL_M,
        sdf_trunc=TRUNCATION_M,
        color_type=o3d.pipelines.integration.TSDFVolumeColorType.RGB8,
    )
    frames = nearest(sequence.timestamps_s, recording.timestamps_s)
    for i, time_s, T in zip(frames, recording.timestamps_s, T_world_cam, strict=True):
        frame = sequence.frame(int(i))
        if abs(frame.timestamp_s - time_s) > LONGEST_WAIT_S:
            continue
        colour = cv2.remap(frame.rgb, *straight, cv2.INTER_LINEAR)
        depth_m = cv2.remap(frame.depth_m, *straight, cv2.INTER_NEAREST)
        image = o3d.geometry.RGBDImage.create_from_color_and_depth(
            o3d.geometry.Image(colour),
            o3d.geometry.Image(depth_m),
            depth_scale=1.0,
            depth_trunc=FARTHEST_M,
            convert_rgb_to_intensity=False,
        )
        volume.integrate(image, pinhole, inverse(T))
    return volume.extract_triangle_mesh()


def _wallpaper(photograph: Image, directions: FloatArray) -> FloatArray:
    """Return the (P, 3) colours of a photograph around a place, mirrored from copy to copy."""
    height, width = photograph.shape[:2]
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    elevation = np.arcsin(directions[:, 2] / np.linalg.norm(directions, axis=1))
    turns = (3.0 * azimuth / np.pi) % 2.0
    columns = np.minimum(turns, 2.0 - turns) * (width - 1)
    rows = (0.5 - elevation / np.pi) * (height - 1)
    return np.asarray(photograph[rows.astype(int), columns.astype(int)], np.float64)
