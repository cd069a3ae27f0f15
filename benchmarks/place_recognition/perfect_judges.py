# SPDX-License-Identifier: Apache-2.0
"""What judges would reach that know by measurement what a recognizer has to guess from pixels."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from benchmarks.place_recognition.measured import score_of
from benchmarks.place_recognition.tables import markdown, number
from placerec.comparison import Similarities
from placerec.datasets import PlaceDataset
from placerec.datasets.tum import STRIDE, read_recording
from slam.config import InputConfig
from slam.datasets import open_sequence
from slam.features import back_project, undistort
from slam.se3 import from_quaternion, from_rotation_translation, inverse, transform
from slam.trajectory import nearest
from slam.types import Camera, FloatArray

STEP_PX = 8
"""Of each image every so many rows and columns are looked at."""
OCCLUDED_M = 0.1
"""A point so far behind what another image sees there is hidden from it."""
OUT_OF_SIGHT = 1.0
"""How far a point has moved that left the image, in focal lengths: about an image's width."""


class View(NamedTuple):
    """An image as depth and true pose tell it.

    Attributes:
        points_m: (P, 3) what some of its pixels see, in the world.
        rays: (P, 2) where in the image that is, in focal lengths from its centre.
        depth_m: (H, W) metres, 0 where unknown.
        T_cam_world: (4, 4).
    """

    points_m: FloatArray
    rays: FloatArray
    depth_m: FloatArray
    T_cam_world: FloatArray


def perfect_judges_table(desk: PlaceDataset) -> str:
    """Return what four judges reach on a recording in TUM RGB-D's format, all of them exact.

    Two know from depth and true poses what a picture shows: how much of what one image sees the
    other sees too, and how far it has moved in it. Two know one half of the true pose.
    """
    folder = desk.paths[0].parents[1]
    frames = read_recording(folder, STRIDE)
    seen, moved = _compare_pictures(list(_views(desk)), open_sequence(folder, InputConfig()).camera)
    half_cosines = np.abs(frames.quaternions @ frames.quaternions.T).clip(max=1.0)
    metres = np.linalg.norm(frames.positions_m[:, None] - frames.positions_m, axis=2)
    judges = {
        "how much of the same both images show": seen,
        "how far it is from one's place in the image to the other's": -moved,
        "the angle between the two cameras": -2.0 * np.arccos(half_cosines),
        "the distance of the two cameras": -metres,
    }
    rows = []
    for name, values in judges.items():
        score = score_of(values.astype(np.float32), desk)
        rows.append(
            (
                name,
                number(score.average_precision),
                number(score.recall_at_1),
                number(score.recall_at_full_precision),
            )
        )
    return markdown(
        ("a judge that knows", "average precision", "recall@1", "recall at 100 % P"), rows
    )


def _views(desk: PlaceDataset) -> Iterator[View]:
    folder = desk.paths[0].parents[1]
    sequence = open_sequence(folder, InputConfig())
    recording = read_recording(folder, STRIDE)
    camera = sequence.camera
    rows, columns = np.mgrid[
        STEP_PX // 2 : camera.height : STEP_PX, STEP_PX // 2 : camera.width : STEP_PX
    ].reshape(2, -1)
    pixels = undistort(np.stack([columns, rows], axis=1).astype(np.float64), camera)
    for k, i in enumerate(nearest(sequence.timestamps_s, recording.timestamps_s)):
        depth_image_m = sequence.frame(int(i)).depth_m.astype(np.float64)
        depth_m = depth_image_m[rows, columns]
        is_known = depth_m > 0.0
        points_m = back_project(pixels[is_known], depth_m[is_known], camera)
        T_world_cam = from_rotation_translation(
            from_quaternion(recording.quaternions[k]), recording.positions_m[k]
        )
        rays = points_m[:, :2] / points_m[:, 2:]
        yield View(transform(T_world_cam, points_m), rays, depth_image_m, inverse(T_world_cam))


def _compare_pictures(views: list[View], camera: Camera) -> tuple[Similarities, Similarities]:
    """Return (N, N) shares of points seen by both of two images, and how far they moved."""
    both = np.array([[_look_again(a, b, camera) for b in views] for a in views])
    seen, moved = (0.5 * (one + one.T) for one in np.moveaxis(both, 2, 0))
    return seen, moved


def _look_again(a: View, b: View, camera: Camera) -> tuple[float, float]:
    """Return which share of what a sees b sees too, and how far it moves between both images."""
    x, y, z_m = transform(b.T_cam_world, a.points_m).T
    is_ahead = z_m > 0.1
    rays = np.stack([x, y], axis=1) / np.where(is_ahead, z_m, 1.0)[:, None]
    columns = (camera.fx * rays[:, 0] + camera.cx).round()
    rows = (camera.fy * rays[:, 1] + camera.cy).round()
    is_inside = (
        is_ahead & (columns >= 0) & (columns < camera.width) & (rows >= 0) & (rows < camera.height)
    )
    found_m = b.depth_m[rows[is_inside].astype(int), columns[is_inside].astype(int)]
    is_hidden = (found_m > 0.0) & (z_m[is_inside] - found_m > OCCLUDED_M)
    far = np.linalg.norm(rays - a.rays, axis=1)
    moved = np.where(is_inside, far, OUT_OF_SIGHT).clip(max=OUT_OF_SIGHT)
    share = (np.count_nonzero(is_inside) - np.count_nonzero(is_hidden)) / len(x)
    return float(share), float(moved.mean())
