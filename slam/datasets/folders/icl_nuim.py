# SPDX-License-Identifier: Apache-2.0
"""ICL-NUIM, rendered living rooms and offices with exact truth, in both forms it is published in.

A. Handa, T. Whelan, J. McDonald and A. J. Davison, "A Benchmark for RGB-D Visual Odometry, 3D
Reconstruction and SLAM", ICRA 2014. POV-Ray rendered it: its camera looks along z with y upwards,
which the authors write as fy = -480, in a left-handed world. Poses are mirrored here, camera and
world alike, so that they are of a usual camera (y down) in a right-handed world.
"""

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.datasets.images import BrokenImage, content_of
from placerec.datasets.tum_lists import as_numbers, named_file, read_lines, split_fields
from slam.config import InputConfig
from slam.datasets.cameras import named_camera, rescaled
from slam.datasets.images import FRAMES_PER_S, numbered_images
from slam.datasets.sequence import ImagePair, Sequence, pairs_in_order
from slam.datasets.true_poses import read_pose_list, rigid
from slam.geometry import se3
from slam.types import Camera, FloatArray, SlamError, Trajectory

CAMERA = Camera(640, 480, 481.2, 480.0, 319.5, 239.5, depth_scale=5000.0)
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
_ORIGINAL_NAME = re.compile(r"scene_\d+_(\d+)\.png")
_VECTOR = re.compile(r"(cam_pos|cam_dir|cam_up)\s*=\s*\[([^\]]*)\]")


def open_icl_nuim(path: Path, config: InputConfig) -> Sequence:
    """Open the "TUM RGB-D compatible PNGs": associations.txt and the truth in a *.gt.freiburg.

    Both count images, at 30 a second; the first image has no true pose.
    """
    warnings: list[str] = []
    images, ends_s = _read_associations(path / "associations.txt", warnings)
    files = sorted(path.glob("[!.]*.gt.freiburg"))
    if len(files) > 1:
        raise SlamError(
            f"there are {len(files)} files of true poses, {files[0].name} and {files[1].name};"
            f" leave the one of this sequence: {path}"
        )
    published = read_pose_list(files[0], warnings)
    truth = None
    if published is not None:
        truth = Trajectory(
            published.timestamps_s / FRAMES_PER_S, _MIRROR @ published.T_world_cam @ _MIRROR
        )
    return Sequence(
        path.resolve().name,
        rescaled(named_camera(path, config) or CAMERA, config),
        images,
        ground_truth=truth,
        warnings=tuple(warnings),
        session_ends_s=ends_s,
    )


def _read_associations(file: Path, warnings: list[str]) -> tuple[list[ImagePair], FloatArray]:
    images = []
    for number, line in read_lines(file):
        fields = split_fields(line)
        frames = as_numbers(" ".join(fields[::2]))
        if len(fields) != 4 or frames is None or frames != [int(frames[0])] * 2:
            raise SlamError(
                f'line {number} is not "frame depth-image frame colour-image", with the same whole'
                f" number twice: {line!r}: {file}"
            )
        # Lists made by the tools of the TUM benchmark have the colour image first.
        depth, color = sorted(fields[1::2], key=lambda name: not name.startswith("depth"))
        paths = (named_file(file.parent, name) for name in (color, depth))
        images.append(ImagePair(frames[0] / FRAMES_PER_S, *paths))
    if not images:
        raise SlamError(f"the list names no image: {file}")
    return pairs_in_order(images, file, warnings)


def open_icl_nuim_original(path: Path, config: InputConfig) -> Sequence:
    """Open the images as rendered: scene_00_0000.png, .depth and, with the pose, .txt, and so on.

    A .depth holds a number per pixel, as text: the distance from the camera in metres.
    """
    colors = numbered_images(path, _ORIGINAL_NAME)
    camera = rescaled(named_camera(path, config) or replace(CAMERA, depth_scale=1.0), config)
    images = [
        ImagePair(number / FRAMES_PER_S, color, color.with_suffix(".depth"))
        for number, color in colors.items()
    ]
    poses = [
        (pair.timestamp_s, _read_pov_pose(pair.color_path.with_suffix(".txt")))
        for pair in images
        if pair.color_path.with_suffix(".txt").is_file()
    ]
    truth = None
    if poses:
        truth = Trajectory(np.array([t for t, _ in poses]), np.array([T for _, T in poses]))
    return Sequence(
        path.resolve().name,
        camera,
        images,
        ground_truth=truth,
        read_depth_file=partial(_read_distances, camera=camera),
    )


def _read_pov_pose(file: Path) -> FloatArray:
    """Return T_world_cam of a camera that POV-Ray describes by position, direction and up."""
    vectors: dict[str, FloatArray] = {}
    for _, line in read_lines(file):
        if match := _VECTOR.match(line):
            values = as_numbers(match[2])
            if values is not None and len(values) == 3:
                vectors[match[1]] = np.array(values)
    if len(vectors) != 3:
        raise SlamError(
            f"cam_pos, cam_dir and cam_up are not all there, three numbers each: {file}"
        )
    forward = _unit(vectors["cam_dir"])
    right = _unit(np.cross(vectors["cam_up"], forward))
    R = np.stack([right, np.cross(forward, right), forward], axis=1)
    T = se3.from_rotation_translation(R, vectors["cam_pos"])
    return _MIRROR @ rigid(T, "the camera", file) @ _MIRROR


def _unit(vector: FloatArray) -> FloatArray:
    length = float(np.linalg.norm(vector))
    return vector / length if length else np.full(3, np.nan)


def _read_distances(file: Path, camera: Camera) -> NDArray[np.float32] | BrokenImage:
    """Return the depth along the optical axis, metres, from distances along the viewing rays."""
    content = content_of(file)
    if isinstance(content, BrokenImage):
        return content
    try:
        with np.errstate(over="ignore"):  # infinite is as good as unknown
            values = np.array(content.split(), dtype=np.float32)
    except ValueError:
        return BrokenImage(file, "not a list of numbers")
    if len(values) != camera.width * camera.height:
        wanted = f"{camera.width}x{camera.height}"
        return BrokenImage(file, f"the file is cut off: {len(values)} numbers for {wanted} pixels")
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    lengths = np.sqrt(x[None, :] ** 2 + y[:, None] ** 2 + 1.0) * camera.depth_scale
    depth_m = values.reshape(lengths.shape) / lengths.astype(np.float32)
    return np.where(np.isfinite(depth_m), depth_m, np.float32(0.0))
