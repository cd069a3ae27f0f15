# SPDX-License-Identifier: Apache-2.0
"""Exports of Stray Scanner, an app for iPhones with LiDAR: rgb.mp4, depth/, odometry.csv ...

https://github.com/strayrobots/scanner says what they hold, and its code how it is written: a frame
of the video, a depth image and a line of odometry.csv share their number, and the poses are of a
camera with y down. No export of a real phone was at hand when this was written.
"""

import re
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.datasets.images import BrokenImage, decode
from placerec.datasets.tables import read_csv
from placerec.datasets.times import in_order, in_seconds
from placerec.datasets.tum_lists import as_numbers
from slam.config import InputConfig
from slam.datasets.cameras import camera_of_matrix, named_camera, rescaled
from slam.datasets.images import numbered_images, read_color, read_depth, read_size
from slam.datasets.phones.fitting import Fitting
from slam.datasets.phones.video import Video
from slam.datasets.sequence import ColorReader, ImagePair, Sequence, pairs_in_order
from slam.datasets.true_poses import read_matrix
from slam.evaluation.trajectory import from_rows
from slam.types import SlamError, Trajectory

VIDEO = "rgb.mp4"
_DEPTH_NAME = re.compile(r"(\d+)\.(?:png|npy)")
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_MIN_CONFIDENCE = 1  # of 0, 1, 2; what the makers' viewer keeps unless told otherwise
_MANY_LOST = 0.02


def open_stray_scanner(path: Path, config: InputConfig) -> Sequence:
    """Open rgb.mp4 (or rgb/), depth/, confidence/, camera_matrix.csv and odometry.csv.

    Depth is in millimetres, and unknown where its confidence is low. Times are odometry.csv's; its
    poses are an estimate, no truth.
    """
    warnings: list[str] = []
    file = path / "odometry.csv"
    rows = _read_odometry(file)
    times_s = in_seconds(np.array([row[0] for _, row in rows]), file, warnings)
    stamps_s = {frame: time_s for (frame, _), time_s in zip(rows, times_s.tolist(), strict=True)}
    depths = numbered_images(path / "depth", _DEPTH_NAME)
    colors, read, size = _colors(path, stamps_s, warnings)
    camera = named_camera(path, config) or camera_of_matrix(
        read_matrix(path / "camera_matrix.csv", size=3), size, path / "camera_matrix.csv"
    )
    if not (path / "confidence").is_dir():
        warnings.append("there is no folder confidence/; depth was used however uncertain it is")
    fitting = Fitting(rescaled(camera, config))
    units_per_m = fitting.color_camera.depth_scale
    images = [
        ImagePair(time_s, colors[n], depths.get(n, path / "depth" / f"{n:06d}.png"))
        for n, time_s in stamps_s.items()
        if n in colors
    ]
    if not images:
        raise SlamError(f"no line is of a frame that has a colour image: {file}")
    images, ends_s = pairs_in_order(images, file, warnings)
    return Sequence(
        path.resolve().name,
        fitting.camera,
        images,
        warnings=tuple(warnings),
        session_ends_s=ends_s,
        read_color_file=lambda file: fitting.fit_color(read(file), file),
        read_depth_file=lambda file: fitting.fit_depth(_read_depth(file, units_per_m), file),
    )


def stray_odometry(path: Path) -> Trajectory:
    """Read what the phone itself took for its path: odometry.csv of an export's folder.

    T_world_cam is of a camera with y down, in ARKit's world, whose y is up.

    Raises:
        LoopcloseError: a line is no pose with its time and frame in finite numbers.
    """
    file = path / "odometry.csv"
    rows = np.array([row for _, row in _read_odometry(file)])
    rows[:, 0] = in_seconds(rows[:, 0], file, [])
    kept, times_s, _ = in_order(rows[:, 0], file, [])
    return from_rows(np.column_stack([times_s, rows[kept, 1:]]))


def _read_odometry(file: Path) -> list[tuple[int, list[float]]]:
    """Return (frame, [time, position, quaternion]) of each line: seconds, metres, x y z w."""
    rows = []
    for number, fields in read_csv(file, ("frame", "timestamp", *_POSE)):
        values = as_numbers(" ".join(fields))
        if values is None or len(values) != len(fields) or values[0] != int(values[0]):
            raise SlamError(f"line {number} is no frame, time and pose, finite numbers: {file}")
        if not any(values[-4:]):
            raise SlamError(f"line {number} has a quaternion of length zero: {file}")
        rows.append((int(values[0]), values[1:]))
    if not rows:
        raise SlamError(f"the table has no line behind its header: {file}")
    return rows


def _colors(
    path: Path, stamps_s: dict[int, float], warnings: list[str]
) -> tuple[dict[int, Path], ColorReader, tuple[int, int]]:
    """Return the colour images by number, what reads them, and their (width, height), pixels."""
    if not (path / VIDEO).is_file():
        images = numbered_images(path / "rgb")
        return images, read_color, read_size(images.values())
    video, frames = Video(path / VIDEO), max(stamps_s) + 1
    lost = abs(video.count - frames)
    differ = f"{VIDEO} has {video.count} frames, odometry.csv counts {frames}"
    if lost > max(1.0, _MANY_LOST * frames):
        raise SlamError(f"{differ}; which colour belongs to which depth is not known: {path}")
    if lost:
        warnings.append(f"{differ}; colour may be {lost} frame(s) off its depth")
    images = {n: path / VIDEO / f"{n:06d}" for n in stamps_s if n >= 0}
    return images, lambda image: video.frame(int(image.name)), (video.width, video.height)


def _read_depth(path: Path, depth_scale: float) -> NDArray[np.float32] | BrokenImage:
    """Return depth, metres, 0 where unknown or hardly trusted."""
    depth_m = read_depth(path, depth_scale)
    if isinstance(depth_m, BrokenImage):
        return depth_m
    folder = path.parent.with_name("confidence")
    if folder.is_dir():
        confidence = decode(folder / f"{path.stem}.png", cv2.IMREAD_GRAYSCALE)
        if isinstance(confidence, BrokenImage):
            return confidence
        if confidence.shape != depth_m.shape:
            return BrokenImage(folder / f"{path.stem}.png", "not of the size of its depth image")
        depth_m[confidence < _MIN_CONFIDENCE] = 0.0
    return depth_m
