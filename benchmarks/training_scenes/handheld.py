# SPDX-License-Identifier: Apache-2.0
"""Views of a hand-held camera: its poses, what a cheap one makes of an image, and folders."""

import shutil
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from slam.geometry.se3 import from_rotation_translation, to_quaternion
from slam.types import FloatArray

PATH_VIEWS, PATH_S = 480, 45.0  # of which readers of video use every third
R_BODY_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def pose(position_m: FloatArray, yaw_rad: float, pitch_rad: float, roll_rad: float) -> FloatArray:
    """Return T_world_cam: looking along x for zero angles, up with the pitch, z is up."""
    R_world_body = Rotation.from_euler("ZY", [yaw_rad, -pitch_rad]).as_matrix()
    R_cam_rolled = Rotation.from_euler("z", roll_rad).as_matrix()
    return from_rotation_translation(R_world_body @ R_BODY_CAM @ R_cam_rolled, position_m)


def nudged(T_world_cam: FloatArray, reach: float, rng: np.random.Generator) -> FloatArray:
    """Return a pose at most so far away (eq. 10), the distance split between both kinds."""
    far, share = reach * rng.random() ** 0.5, rng.uniform(0.2, 0.9)
    moved_m, turned_rad = rng.normal(size=(2, 3))
    moved_m *= far * share / np.linalg.norm(moved_m)
    turned_rad *= far * (1.0 - share) / np.linalg.norm(turned_rad)
    R = T_world_cam[:3, :3] @ Rotation.from_rotvec(turned_rad).as_matrix()
    return from_rotation_translation(R, T_world_cam[:3, 3] + moved_m)


def path_times_s() -> FloatArray:
    """Return the (PATH_VIEWS,) times of the views of a path."""
    return np.linspace(0.0, PATH_S, PATH_VIEWS)


def swing(
    times_s: FloatArray, rng: np.random.Generator, amplitude: float, fastest: float = 0.7
) -> FloatArray:
    """Return (T,) values to and fro without an exact period, as a hand moves."""
    speeds, phases = rng.uniform(0.1, fastest, (4, 1)), rng.uniform(0.0, 2.0 * np.pi, (4, 1))
    waves = np.sin(speeds * times_s + phases).sum(axis=0)
    return np.asarray(amplitude * waves / np.abs(waves).max())


Image = NDArray[np.uint8]
Views = Iterable[tuple[float, Image, FloatArray, int | None]]
"""(seconds, (H, W, 3) image, T_world_cam, which place it is meant to show) each."""


def as_cheap_cameras_see(image: Image, rng: np.random.Generator) -> Image:
    """Return a (H, W, 3) uint8 view in another exposure and tint, some faded, blurred, or noisy."""
    changed = image.astype(np.float32) / 255.0
    gain, gamma = np.exp(rng.normal(0.0, (0.2, 0.16)))
    changed = np.clip(changed * gain, 0.0, 1.0) ** gamma * np.exp(rng.normal(0.0, 0.04, 3))
    if rng.random() < 0.3:
        changed += rng.random() * (changed.mean(axis=2, keepdims=True) - changed)
    if rng.random() < 0.3:
        changed = cv2.GaussianBlur(changed, (0, 0), rng.uniform(0.5, 1.6))
    changed = changed + rng.normal(0.0, rng.uniform(0.0, 0.025), changed.shape)
    return np.asarray(np.clip(np.rint(255.0 * changed), 0, 255), np.uint8)


def write_folder(folder: Path, views: Views) -> None:
    """Write views; the folder is complete or not there."""
    unfinished = folder.with_name(f".{folder.name}")
    shutil.rmtree(unfinished, ignore_errors=True)
    (unfinished / "rgb").mkdir(parents=True)
    frames, truth, places = [], [], []
    for time_s, image, T_world_cam, place in views:
        stamp = f"{time_s:.6f}"
        cv2.imwrite(str(unfinished / "rgb" / f"{stamp}.png"), image[..., ::-1])
        frames.append(f"{stamp} rgb/{stamp}.png\n")
        values = (*T_world_cam[:3, 3], *to_quaternion(T_world_cam[:3, :3]))
        truth.append(f"{stamp} {' '.join(f'{value:.6f}' for value in values)}\n")
        if place is not None:
            places.append(f"{stamp} {place}\n")
    if places:
        (unfinished / "places.txt").write_text("".join(places))
    (unfinished / "rgb.txt").write_text("".join(frames))
    (unfinished / "groundtruth.txt").write_text("".join(truth))
    unfinished.rename(folder)
