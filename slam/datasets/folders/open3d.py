# SPDX-License-Identifier: Apache-2.0
"""Folders as Open3D's reconstruction system takes them, and the Redwood recordings made for it.

Open3D's own `realsense_recorder.py` and `RGBDVideoReader.save_frames` (for the .bag files of a
RealSense and the .mkv files of an Azure Kinect) write such folders. Its samples are such folders
too, but may lack the camera, which its examples take to be `PrimeSenseDefault` then.
"""

import re
from pathlib import Path

import numpy as np

from placerec.datasets.times import MICROSECONDS, in_seconds
from placerec.datasets.tum_lists import (
    as_number,
    as_numbers,
    as_whole_number,
    is_whole,
    read_lines,
    split_fields,
)
from slam.config import InputConfig
from slam.datasets.cameras import UNITS_PER_M, named_camera, read_intrinsics, rescaled
from slam.datasets.images import ANY_IMAGE, FRAMES_PER_S, NumberedPair, numbered_pairs, read_size
from slam.datasets.sequence import ImagePair, Sequence, pairs_in_order
from slam.datasets.true_poses import known_poses, read_pose_log
from slam.types import Camera, FloatArray, SlamError, Trajectory

_COLOR_FOLDERS = ("color", "rgb", "image")
_CAMERA_FILES = ("camera_intrinsic.json", "intrinsic.json", "camera_primesense.json")
PRIMESENSE = Camera(640, 480, 525.0, 525.0, 319.5, 239.5, depth_scale=UNITS_PER_M)
_MICROSECONDS = re.compile(r"\d+-(\d+)")  # of Redwood's names, such as 0000002-000000033369.jpg


def open_open3d(path: Path, config: InputConfig) -> Sequence:
    """Open a folder of color/ (or rgb/, image/), depth/, a camera and perhaps trajectory.log.

    Images are paired by their numbers, and taken 30 times a second unless their names tell the
    time. Depth is in millimetres unless the camera file has another depth_scale. Without a camera
    file, images of 640x480 pixels are taken to be Open3D's default camera's.
    """
    warnings: list[str] = []
    pairs = numbered_pairs(_color_folder(path), path / "depth", warnings)
    images = [
        ImagePair(time_s, color, depth)
        for time_s, (_, color, depth) in zip(_times_s(pairs, warnings), pairs, strict=True)
    ]
    if (np.diff([pair.timestamp_s for pair in images]) <= 0.0).any():
        raise SlamError(
            "the times in the names of the images, microseconds behind the dash, do not increase"
            f" with their numbers: {_color_folder(path)}"
        )
    log = path / "trajectory.log"
    return Sequence(
        path.resolve().name,
        rescaled(named_camera(path, config) or _own_camera(path, images, warnings), config),
        images,
        ground_truth=_read_truth(log, images, warnings) if log.is_file() else None,
        warnings=tuple(warnings),
    )


def _color_folder(path: Path) -> Path:
    """Return the folder of the colour images, under whichever of its usual names."""
    return next(path / name for name in _COLOR_FOLDERS if (path / name).is_dir())


def _times_s(pairs: list[NumberedPair], warnings: list[str]) -> list[float]:
    matches = [_MICROSECONDS.fullmatch(color.stem) for _, color, _ in pairs]
    stamps = np.array([float(match[1]) for match in matches if match])
    if len(stamps) < len(pairs):
        return [
            float(match[1]) * 1e-6 if match else pair.number / FRAMES_PER_S
            for match, pair in zip(matches, pairs, strict=True)
        ]
    folder = pairs[0].color.parent
    return list(map(float, in_seconds(stamps, folder, warnings, usual=MICROSECONDS)))


def _own_camera(path: Path, images: list[ImagePair], warnings: list[str]) -> Camera:
    file = next((path / name for name in _CAMERA_FILES if (path / name).is_file()), None)
    if file is not None:
        return read_intrinsics(file)
    width, height = read_size(pair.color_path for pair in images)
    if (width, height) != (PRIMESENSE.width, PRIMESENSE.height):
        raise SlamError(
            f"the folder tells no camera, and images of {width}x{height} pixels are not of Open3D's"
            f" default, which has {PRIMESENSE.width}x{PRIMESENSE.height}; give the camera that made"
            f" them with --input.camera FILE.toml, or put its {_CAMERA_FILES[0]} there: {path}"
        )
    warnings.append(
        "the folder tells no camera; it is taken to be Open3D's PrimeSenseDefault (fx = fy ="
        f" {PRIMESENSE.fx:g}, cx = {PRIMESENSE.cx:g}, cy = {PRIMESENSE.cy:g},"
        f" {PRIMESENSE.depth_scale:g} depth units per metre), unless --input.camera names it"
    )
    return PRIMESENSE


def _read_truth(log: Path, images: list[ImagePair], warnings: list[str]) -> Trajectory | None:
    """Return the poses with the times of their images: one for each, or of those they count."""
    poses = read_pose_log(log)
    frames = [frame for frame, _ in poses]
    if len(poses) == len(images):
        frames = list(range(len(images)))
    if not frames or np.diff([-1, *frames, len(images)]).min() < 1:
        raise SlamError(
            f"there are {len(poses)} poses for {len(images)} images, and their numbers do not tell"
            f" which is whose; remove the file to run without ground truth: {log}"
        )
    stamps_s: FloatArray = np.array([images[frame].timestamp_s for frame in frames])
    truth = Trajectory(stamps_s, np.array([T for _, T in poses]))
    return known_poses(truth, log, warnings)


def open_realsense(path: Path, config: InputConfig) -> Sequence:
    """Open a folder of color/ (or rgb/, image/), depth/, intrinsics.json, timestamps.csv (or .txt).

    Images are paired by their numbers. A line of timestamps is the number or name of an image and
    its time, or a time alone, one for each image. Times are in milliseconds, as pyrealsense2 gives
    them, or in whichever unit their steps tell.
    """
    warnings: list[str] = []
    pairs = numbered_pairs(_color_folder(path), path / "depth", warnings)
    names = ("timestamps.csv", "timestamps.txt")
    file = next(path / name for name in names if (path / name).exists())
    stamps_s = _read_times(file, [pair.number for pair in pairs], warnings)
    timed = [pair for pair in pairs if pair.number in stamps_s]
    if not timed:
        raise SlamError(f"no line is of an image in {_color_folder(path).name}/: {file}")
    if len(timed) < len(pairs):
        warnings.append(
            f"{len(pairs) - len(timed)} of {len(pairs)} images have no line in {file.name} and are"
            " not used"
        )
    images = [ImagePair(stamps_s[number], color, depth) for number, color, depth in timed]
    camera = named_camera(path, config) or read_intrinsics(path / "intrinsics.json")
    images, ends_s = pairs_in_order(images, file, warnings)
    return Sequence(
        path.resolve().name,
        rescaled(camera, config),
        images,
        warnings=tuple(warnings),
        session_ends_s=ends_s,
    )


def _read_times(file: Path, numbers: list[int], warnings: list[str]) -> dict[int, float]:
    """Return the time, seconds, of each numbered image that has one."""
    lines = list(read_lines(file))
    if lines and not any(as_numbers(field) for field in split_fields(lines[0][1])):
        del lines[0]  # the columns' names
    rows = [_read_row(number, line, file) for number, line in lines]
    if not rows:
        raise SlamError(f"the list holds no time: {file}")
    if len({image is None for image, _ in rows}) == 2:
        raise SlamError(f"some lines name an image and its time, others hold a time alone: {file}")
    if rows[0][0] is None:
        if len(rows) != len(numbers):
            raise SlamError(f"there are {len(rows)} times for {len(numbers)} images: {file}")
        rows = [(image, time) for image, (_, time) in zip(numbers, rows, strict=True)]
    images = [image for image, _ in rows if image is not None]
    are_whole = all(is_whole(time) for _, time in rows)
    stamps = np.array([as_number(time) for _, time in rows], np.float64)
    stamps_s = in_seconds(stamps, file, warnings, are_whole=are_whole)
    return dict(zip(images, stamps_s.tolist(), strict=True))


def _read_row(number: int, line: str, file: Path) -> tuple[int | None, str]:
    """Return (image number or None, time as written) of one line."""
    fields = split_fields(line) or [""]  # of nothing but commas
    named = ANY_IMAGE.fullmatch(Path(fields[0]).name)
    image = named[1] if named else fields[0]
    time = fields[0] if len(fields) == 1 else fields[1]
    image_number = as_whole_number(image) if len(fields) > 1 else None
    if as_number(time) is None or (len(fields) > 1 and image_number is None):
        raise SlamError(f'line {number} is neither "image time" nor "time": {line!r}: {file}')
    return image_number, time
