# SPDX-License-Identifier: Apache-2.0
"""ScanNet, as its SensReader exports a .sens file: color/, depth/, pose/, intrinsic/.

A. Dai, A. X. Chang, M. Savva, M. Halber, T. Funkhouser and M. Niessner, "ScanNet: Richly-annotated
3D Reconstructions of Indoor Scenes", CVPR 2017. Colour images are twice as large as depth images.
Both are seen from the same place, so that colour is brought to the size of depth, and depth moved
to where the colour camera sees it, by a pixel at most.
"""

from pathlib import Path

import numpy as np

from slam.config import InputConfig
from slam.datasets.cameras import camera_of_matrix, named_camera, rescaled
from slam.datasets.images import FRAMES_PER_S, NumberedPair, numbered_pairs, read_size
from slam.datasets.registration import Registration, resized
from slam.datasets.sequence import ImagePair, Sequence
from slam.datasets.true_poses import read_matrix, read_pose_files
from slam.types import Camera


def open_scannet(path: Path, config: InputConfig) -> Sequence:
    """Open color/0.jpg, depth/0.png (mm), pose/0.txt, ... (30 Hz) and intrinsic/*.txt.

    A pose of -inf is unknown. Where a camera is named, colour and depth are taken to be registered
    to it.
    """
    warnings: list[str] = []
    pairs = numbered_pairs(path / "color", path / "depth", warnings)
    poses = [(n / FRAMES_PER_S, path / "pose" / f"{color.stem}.txt") for n, color, _ in pairs]
    camera, registration = named_camera(path, config), None
    if camera is None:
        registration = _registration(path / "intrinsic", pairs)
        camera = registration.camera
    return Sequence(
        path.resolve().name,
        rescaled(camera, config),
        [ImagePair(n / FRAMES_PER_S, color, depth) for n, color, depth in pairs],
        ground_truth=read_pose_files(poses, warnings),
        warnings=tuple(warnings),
        registration=registration,
    )


def _registration(folder: Path, pairs: list[NumberedPair]) -> Registration:
    color_size = read_size(pair.color for pair in pairs)
    depth_size = read_size(pair.depth for pair in pairs)
    color_file, depth_file = folder / "intrinsic_color.txt", folder / "intrinsic_depth.txt"
    if color_size == depth_size and depth_file.is_file():
        # The exporter can make colour as small as depth, and still writes its old intrinsics.
        camera = _read_camera(depth_file, depth_size)
        return Registration(camera, camera, np.eye(4))
    color_camera = _read_camera(color_file, color_size)
    if not depth_file.is_file():
        return Registration(color_camera, resized(color_camera, *depth_size), np.eye(4))
    return Registration(color_camera, _read_camera(depth_file, depth_size), np.eye(4))


def _read_camera(file: Path, size: tuple[int, int]) -> Camera:
    return camera_of_matrix(read_matrix(file), size, file)
