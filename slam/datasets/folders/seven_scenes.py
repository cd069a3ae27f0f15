# SPDX-License-Identifier: Apache-2.0
"""Microsoft 7-Scenes, Kinect recordings with poses by KinectFusion: frame-000000.color.png ...

J. Shotton, B. Glocker, C. Zach, S. Izadi, A. Criminisi and A. Fitzgibbon, "Scene Coordinate
Regression Forests for Camera Relocalization in RGB-D Images", CVPR 2013. The images are as the
sensors gave them, colour and depth not registered; the poses are the depth camera's, found with a
focal length of 585 pixels. The rest of the calibration was never published. What is usual in its
place: a colour camera of 525 pixels, and the motion between the two cameras that was measured on
another Kinect (LIRIS, https://projet.liris.cnrs.fr/voir/activities-dataset/kinect-calibration.html).

A. Zeng's TSDF tools (tsdf-fusion-python) have files of the same names with a camera-intrinsics.txt,
which is of colour and depth alike: such images are taken to be registered.
"""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from slam.config import InputConfig
from slam.datasets.cameras import camera_of_matrix, named_camera, rescaled
from slam.datasets.images import FRAMES_PER_S, numbered_images, read_size
from slam.datasets.registration import Registration
from slam.datasets.sequence import ImagePair, Sequence
from slam.datasets.true_poses import read_matrix, read_pose_files
from slam.geometry import se3
from slam.types import Camera

_NAME = re.compile(r"frame-(\d+)\.color\.(?:png|jpg)")
_CAMERA_FILE = "camera-intrinsics.txt"
_T_COLOR_DEPTH = np.array(
    [
        [0.99996518, 0.00267651, -0.00790410, -0.02555894],
        [-0.00274093, 0.99996303, -0.00815045, 0.00010110],
        [0.00788199, 0.00817183, 0.99993554, 0.00203183],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
KINECT = Registration(
    color_camera=Camera(640, 480, 525.0, 525.0, 320.0, 240.0, depth_scale=1000.0),
    depth_camera=Camera(640, 480, 585.0, 585.0, 320.0, 240.0, depth_scale=1000.0),
    T_color_depth=_T_COLOR_DEPTH,
)


def open_seven_scenes(path: Path, config: InputConfig) -> Sequence:
    """Open a folder of frame-*.color.png, .depth.png (mm, 65535 unknown) and .pose.txt, at 30 Hz.

    Where a camera is named, or camera-intrinsics.txt is in the folder or the one above, colour and
    depth are taken to be registered to it.
    """
    warnings: list[str] = []
    images = [
        ImagePair(number / FRAMES_PER_S, color, _beside(color, "depth.png"))
        for number, color in numbered_images(path, _NAME).items()
    ]
    camera = named_camera(path, config) or _own_camera(path.resolve(), images)
    registration = None if camera else KINECT
    poses = [(pair.timestamp_s, _beside(pair.color_path, "pose.txt")) for pair in images]
    truth = read_pose_files(poses, warnings)
    if truth and registration:
        T_depth_color = se3.inverse(registration.T_color_depth)
        truth = replace(truth, T_world_cam=truth.T_world_cam @ T_depth_color)
    return Sequence(
        path.resolve().name,
        rescaled(camera or KINECT.camera, config),
        images,
        ground_truth=truth,
        warnings=tuple(warnings),
        registration=registration,
    )


def _own_camera(path: Path, images: list[ImagePair]) -> Camera | None:
    files = (path / _CAMERA_FILE, path.parent / _CAMERA_FILE)
    file = next((file for file in files if file.is_file()), None)
    if file is None:
        return None
    size = read_size(pair.color_path for pair in images)
    return camera_of_matrix(read_matrix(file, size=3), size, file)


def _beside(color: Path, kind: str) -> Path:
    return color.with_name(f"{color.name.split('.')[0]}.{kind}")
