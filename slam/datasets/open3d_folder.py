# SPDX-License-Identifier: Apache-2.0
"""Folders as Open3D's reconstruction system takes them, and the Redwood recordings made for it.

Open3D's own `realsense_recorder.py` and `RGBDVideoReader.save_frames` (for the .bag files of a
RealSense and the .mkv files of an Azure Kinect) write such folders.
"""

import re
from pathlib import Path

import numpy as np

from slam.config import InputConfig
from slam.datasets.cameras import named_camera, rescaled
from slam.datasets.intrinsics import read_intrinsics
from slam.datasets.numbered_images import FRAMES_PER_S, numbered_pairs
from slam.datasets.sequence import ImagePair, Sequence
from slam.datasets.true_poses import read_pose_log
from slam.types import Camera, FloatArray, SlamError, Trajectory

COLOR_FOLDERS = ("color", "rgb", "image")
_CAMERA_FILES = ("camera_intrinsic.json", "intrinsic.json")
_MICROSECONDS = re.compile(r"\d+-(\d+)")  # of Redwood's names, such as 0000002-000000033369.jpg


def open_open3d(path: Path, config: InputConfig) -> Sequence:
    """Open a folder of color/ (or rgb/, image/), depth/, a camera and perhaps trajectory.log.

    Images are paired by their numbers, and taken 30 times a second unless their names tell the
    time. Depth is in millimetres unless the camera file has another depth_scale.

    Raises:
        SlamError: the trajectory, the camera or most images are not usable.
    """
    warnings: list[str] = []
    images = [
        ImagePair(_time_s(number, color), color, depth)
        for number, color, depth in numbered_pairs(color_folder(path), path / "depth", warnings)
    ]
    if (np.diff([pair.timestamp_s for pair in images]) <= 0.0).any():
        raise SlamError(
            "the times in the names of the images, microseconds behind the dash, do not increase"
            f" with their numbers: {color_folder(path)}"
        )
    log = path / "trajectory.log"
    return Sequence(
        path.resolve().name,
        rescaled(named_camera(path, config) or _own_camera(path), config),
        images,
        ground_truth=_read_truth(log, images) if log.is_file() else None,
        warnings=tuple(warnings),
    )


def color_folder(path: Path) -> Path:
    """Return the folder of the colour images, under whichever of its usual names."""
    return next(path / name for name in COLOR_FOLDERS if (path / name).is_dir())


def _time_s(number: int, color: Path) -> float:
    match = _MICROSECONDS.fullmatch(color.stem)
    return int(match[1]) * 1e-6 if match else number / FRAMES_PER_S


def _own_camera(path: Path) -> Camera:
    return read_intrinsics(next(path / name for name in _CAMERA_FILES if (path / name).is_file()))


def _read_truth(log: Path, images: list[ImagePair]) -> Trajectory:
    """Return the poses with the times of their images: one for each, or of those they count."""
    poses = read_pose_log(log)
    frames = [frame for frame, _ in poses]
    if len(poses) == len(images):
        frames = list(range(len(images)))
    if (
        not frames
        or frames[0] < 0
        or frames[-1] >= len(images)
        or np.diff(frames).min(initial=1) < 1
    ):
        raise SlamError(
            f"there are {len(poses)} poses for {len(images)} images, and their numbers do not tell"
            f" which is whose; remove the file to run without ground truth: {log}"
        )
    stamps_s: FloatArray = np.array([images[frame].timestamp_s for frame in frames])
    return Trajectory(stamps_s, np.array([T for _, T in poses]))
