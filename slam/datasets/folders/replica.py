# SPDX-License-Identifier: Apache-2.0
"""Replica, rendered rooms with exact truth, as NICE-SLAM ships it: results/frame000000.jpg ...

J. Straub et al., "The Replica Dataset: A Digital Replica of Indoor Spaces", 2019. The recordings
were rendered for E. Sucar, S. Liu, J. Ortiz and A. J. Davison, "iMAP: Implicit Mapping and
Positioning in Real-Time", ICCV 2021.
"""

import re
from pathlib import Path

import numpy as np

from placerec.datasets.tum_lists import read_lines
from slam.config import InputConfig
from slam.datasets.cameras import named_camera, read_intrinsics, rescaled
from slam.datasets.images import FRAMES_PER_S, numbered_images
from slam.datasets.sequence import ImagePair, Sequence
from slam.datasets.true_poses import known_poses, rigid_or_gap
from slam.types import Camera, SlamError, Trajectory

CAMERA = Camera(1200, 680, 600.0, 600.0, 599.5, 339.5, depth_scale=6553.5)
_CAMERA_FILE = "cam_params.json"
_NAME = re.compile(r"frame(\d+)\.(?:jpe?g|png)")


def open_replica(path: Path, config: InputConfig) -> Sequence:
    """Open results/frame000000.jpg, results/depth000000.png, ... (30 Hz) and perhaps traj.txt.

    The camera is in cam_params.json, in the folder or the one above, where all scenes share it.
    """
    warnings: list[str] = []
    colors = numbered_images(path / "results", _NAME)
    trajectory = path / "traj.txt"
    return Sequence(
        path.resolve().name,
        rescaled(named_camera(path, config) or _own_camera(path.resolve(), warnings), config),
        [
            ImagePair(number / FRAMES_PER_S, color, _depth_of(color))
            for number, color in colors.items()
        ],
        ground_truth=_read_truth(trajectory, list(colors), warnings)
        if trajectory.is_file()
        else None,
        warnings=tuple(warnings),
    )


def _depth_of(color: Path) -> Path:
    return color.with_name(f"{color.stem.replace('frame', 'depth')}.png")


def _own_camera(path: Path, warnings: list[str]) -> Camera:
    files = (path / _CAMERA_FILE, path.parent / _CAMERA_FILE)
    file = next((file for file in files if file.is_file()), None)
    if file is not None:
        return read_intrinsics(file, usual_scale=None)
    warnings.append(
        f"there is no {_CAMERA_FILE} in the folder or above it; the camera is taken to be that of"
        f" NICE-SLAM's download ({CAMERA.width}x{CAMERA.height} pixels, fx = fy = {CAMERA.fx:g},"
        f" cx = {CAMERA.cx:g}, cy = {CAMERA.cy:g}, {CAMERA.depth_scale:g} depth units per metre)"
    )
    return CAMERA


def _read_truth(file: Path, numbers: list[int], warnings: list[str]) -> Trajectory | None:
    """Read T_world_cam, 16 numbers by rows, a line per frame; of numbered images, if some left."""
    poses = []
    for line_number, line in read_lines(file):
        try:
            T = np.array(line.replace(",", " ").split(), dtype=np.float64).reshape(4, 4)
        except ValueError as error:
            raise SlamError(
                f"line {line_number} is not a pose, 4 x 4 numbers: {line!r}: {file}"
            ) from error
        poses.append(rigid_or_gap(T, f"the pose of line {line_number}", file))
    if len(poses) == len(numbers):
        used = poses
    elif numbers[-1] < len(poses):  # images were left out: they keep their lines
        used = [poses[number] for number in numbers]
    else:
        raise SlamError(
            f"there are {len(poses)} poses for {len(numbers)} images, the last of which has the"
            f" number {numbers[-1]}; remove the file to run without ground truth: {file}"
        )
    truth = Trajectory(np.array(numbers) / FRAMES_PER_S, np.array(used))
    return known_poses(truth, file, warnings)
