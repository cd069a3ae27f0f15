# SPDX-License-Identifier: Apache-2.0
"""What judges would reach that know by measurement what a recognizer has to guess from pixels."""

from collections.abc import Iterator
from typing import NamedTuple

import cv2
import numpy as np

from benchmarks.place_recognition.measured import score_of
from benchmarks.place_recognition.tables import markdown, number
from placerec.datasets import PlaceDataset
from placerec.datasets.tum import STRIDE, Recording, read_recording
from slam.config import InputConfig
from slam.datasets import Sequence, open_sequence
from slam.evaluation.trajectory import nearest
from slam.geometry.features import back_project
from slam.geometry.se3 import from_quaternion, from_rotation_translation, inverse, transform
from slam.types import Camera, FloatArray

STEP_PX = 8
"""Of each image every so many rows and columns are looked at."""
LONGEST_WAIT_S = 0.02
"""Between an image and its depth image; where there is none, an image shows nothing."""
OCCLUDED_M = 0.1
"""A point so far behind what another image sees there is hidden from it."""
LEAST_IN_COMMON = 20
"""Points that two images must both show for the way they moved to be told."""
NOTHING_IN_COMMON = 9.0
"""Stands for a bend that cannot be told, larger than any."""


class View(NamedTuple):
    """An image as depth and true pose tell it.

    Attributes:
        points_m: (P, 3) what some of its pixels see, in the world.
        rays: (P, 2) where in the image that is, in focal lengths from its centre.
        depth_m: (H, W) metres of the image without its lens's distortion, 0 where unknown.
        T_cam_world: (4, 4).
    """

    points_m: FloatArray
    rays: FloatArray
    depth_m: FloatArray
    T_cam_world: FloatArray


class Change(NamedTuple):
    """What became of the points of one image in another.

    Attributes:
        seen: share of them that the other image shows, too.
        moved: how far they moved in the image, in widths of it; 1 where they left it.
        bent: how much more some parts moved than others, as a picture grows, turns and shears: the
            size of the (2, 2) matrix that says best how the way depends on the place.
    """

    seen: float
    moved: float
    bent: float


def perfect_judges_table(desk: PlaceDataset) -> str:
    """Return what judges reach on a recording in TUM RGB-D's format, all of them exact.

    Three measure by depth and true poses what a picture shows; two know one half of the true pose.
    """
    frames = read_recording(desk.paths[0].parents[1], STRIDE)
    sequence = open_sequence(desk.paths[0].parents[1], InputConfig())
    views = list(_views(frames, sequence))
    both = np.array([[look_again(a, b, sequence.camera) for b in views] for a in views])
    seen, moved, bent = (0.5 * (one + one.T) for one in np.moveaxis(both, 2, 0))
    half_cosines = np.abs(frames.quaternions @ frames.quaternions.T).clip(max=1.0)
    metres = np.linalg.norm(frames.positions_m[:, None] - frames.positions_m, axis=2)
    judges = {
        "how much of the same both images show": seen,
        "how far it moved between them": -moved,
        "how differently its parts moved": -bent,
        "the angle between the two cameras": -2.0 * np.arccos(half_cosines),
        "the distance of the two cameras": -metres,
    }
    rows = []
    for name, values in judges.items():
        score = score_of(values.astype(np.float32), desk)
        figures = (score.average_precision, score.recall_at_1, score.recall_at_full_precision)
        rows.append((name, *map(number, figures)))
    return markdown(
        ("a judge that knows", "average precision", "recall@1", "recall at 100 % P"), rows
    )


def look_again(a: View, b: View, camera: Camera) -> Change:
    """Return what becomes of the points of one image in another one of a camera."""
    if not len(a.points_m):
        return Change(0.0, 1.0, NOTHING_IN_COMMON)
    x, y, z_m = transform(b.T_cam_world, a.points_m).T
    rays = np.stack([x, y], axis=1) / np.where(z_m > 0.0, z_m, np.inf)[:, None]
    columns = (camera.fx * rays[:, 0] + camera.cx).round()
    rows = (camera.fy * rays[:, 1] + camera.cy).round()
    is_seen = (z_m > 0.0) & (columns >= 0) & (columns < camera.width)
    is_seen &= (rows >= 0) & (rows < camera.height)
    found_m = b.depth_m[rows[is_seen].astype(int), columns[is_seen].astype(int)]
    is_seen[is_seen] = (found_m == 0.0) | (z_m[is_seen] - found_m < OCCLUDED_M)
    way = rays - a.rays
    widths = np.linalg.norm(way, axis=1) * camera.fx / camera.width
    moved = np.where(is_seen, widths, 1.0).clip(max=1.0)
    bent = _bent(a.rays[is_seen], way[is_seen])
    return Change(float(is_seen.mean()), float(moved.mean()), bent)


def _bent(rays: FloatArray, way: FloatArray) -> float:
    if len(rays) < LEAST_IN_COMMON:
        return NOTHING_IN_COMMON
    places = np.concatenate([rays, np.ones((len(rays), 1))], axis=1)
    affine, *_ = np.linalg.lstsq(places, way)
    return float(np.linalg.norm(affine[:2]))


def _views(frames: Recording, sequence: Sequence) -> Iterator[View]:
    camera = sequence.camera
    rows, columns = np.mgrid[
        STEP_PX // 2 : camera.height : STEP_PX, STEP_PX // 2 : camera.width : STEP_PX
    ].reshape(2, -1)
    pixels = np.stack([columns, rows], axis=1).astype(np.float64)
    straight = cv2.initUndistortRectifyMap(
        camera.matrix,
        np.array(camera.distortion),
        np.eye(3),
        camera.matrix,
        (camera.width, camera.height),
        cv2.CV_32FC1,
    )
    for k, i in enumerate(nearest(sequence.timestamps_s, frames.timestamps_s)):
        depth_image_m = cv2.remap(sequence.frame(int(i)).depth_m, *straight, cv2.INTER_NEAREST)
        if abs(sequence.timestamps_s[i] - frames.timestamps_s[k]) > LONGEST_WAIT_S:
            depth_image_m[:] = 0.0
        depth_m = depth_image_m[rows, columns].astype(np.float64)
        is_known = depth_m > 0.0
        points_m = back_project(pixels[is_known], depth_m[is_known], camera)
        T_world_cam = from_rotation_translation(
            from_quaternion(frames.quaternions[k]), frames.positions_m[k]
        )
        rays = points_m[:, :2] / points_m[:, 2:]
        yield View(transform(T_world_cam, points_m), rays, depth_image_m, inverse(T_world_cam))
