# SPDX-License-Identifier: Apache-2.0
"""Views as a cheap camera would take them, and folders of them in TUM RGB-D's format."""

import shutil
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slam.geometry.se3 import to_quaternion
from slam.types import FloatArray

Image = NDArray[np.uint8]
Views = Iterable[tuple[float, Image, FloatArray]]
"""(seconds, (H, W, 3) image, T_world_cam) each."""


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
    frames, truth = [], []
    for time_s, image, T_world_cam in views:
        stamp = f"{time_s:.6f}"
        cv2.imwrite(str(unfinished / "rgb" / f"{stamp}.png"), image[..., ::-1])
        frames.append(f"{stamp} rgb/{stamp}.png\n")
        values = (*T_world_cam[:3, 3], *to_quaternion(T_world_cam[:3, :3]))
        truth.append(f"{stamp} {' '.join(f'{value:.6f}' for value in values)}\n")
    (unfinished / "rgb.txt").write_text("".join(frames))
    (unfinished / "groundtruth.txt").write_text("".join(truth))
    unfinished.rename(folder)
