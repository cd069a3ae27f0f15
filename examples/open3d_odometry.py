# SPDX-License-Identifier: Apache-2.0
"""Close loops on Open3D's RGB-D odometry, in one pass through a recording.

    python examples/open3d_odometry.py SEQUENCE [POSES.txt]

Open3D places each image against the one before, by its colours and its depth; what each step is
off adds up. Its poses are written to POSES.txt (default: open3d_odometry.txt) in the TUM format, so
that `run_slam SEQUENCE --odometry POSES.txt` can be run on them later. Open3D's pinhole camera has
no lens distortion, which is a part of what it is off. An image of 640x480 takes it about a second
on a slow core; where other programs are busy, OMP_NUM_THREADS=1 makes it faster.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import open3d as o3d
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from placerec import load
from slam import (
    Camera,
    Config,
    Frame,
    LoopcloseError,
    Slam,
    SlamResult,
    compare_drift,
    open_sequence,
)
from slam.datasets import Sequence, resolve

CONFIG = Config()
FARTHEST_M = 4.0  # depth beyond is noise, for a Kinect
# Of an image's pixels. Open3D says that it found a motion even where it has nothing to compare: for
# an image without depth, or a dark one. How many pixels it compared, its information matrix tells.
LEAST_COMPARED = 0.01


class Open3dOdometry:
    """Where the camera is by Open3D alone, in the frame of the first image."""

    def __init__(self, camera: Camera) -> None:
        pinhole = camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy
        self._intrinsic = o3d.camera.PinholeCameraIntrinsic(*pinhole)
        self._least_pixels = LEAST_COMPARED * camera.width * camera.height
        self._option = o3d.pipelines.odometry.OdometryOption(depth_max=FARTHEST_M)
        self._before: o3d.geometry.RGBDImage | None = None
        self._T_before_now = np.eye(4)
        self._T_odom_cam = np.eye(4)
        self.failed = 0

    def place(self, frame: Frame) -> NDArray[np.float64]:
        """Return the (4, 4) pose of the next image; where Open3D fails the last motion goes on."""
        now = o3d.geometry.RGBDImage.create_from_color_and_depth(
            o3d.geometry.Image(frame.rgb),
            o3d.geometry.Image(frame.depth_m),
            depth_scale=1.0,
            depth_trunc=FARTHEST_M,
        )
        if self._before is not None:
            _, T_before_now, information = o3d.pipelines.odometry.compute_rgbd_odometry(
                now,
                self._before,
                self._intrinsic,
                np.eye(4),
                o3d.pipelines.odometry.RGBDOdometryJacobianFromHybridTerm(),
                self._option,
            )
            if information[5, 5] >= self._least_pixels and np.isfinite(T_before_now).all():
                self._T_before_now = T_before_now
            else:
                self.failed += 1
            self._T_odom_cam = self._T_odom_cam @ self._T_before_now
        self._before = now
        return self._T_odom_cam


def tum_line(timestamp_s: float, T: NDArray[np.float64]) -> str:
    """Return a pose as `time tx ty tz qx qy qz qw`."""
    numbers = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_quat()]
    return " ".join([f"{timestamp_s:.6f}", *(f"{value:.9f}" for value in numbers)]) + "\n"


def close_loops(sequence: Sequence, poses_file: Path) -> SlamResult:
    """Place every image by Open3D, write its pose, and hand both to `Slam`."""
    odometry, slam = Open3dOdometry(sequence.camera), Slam(sequence.camera, load("learned"), CONFIG)
    with poses_file.open("w") as poses:
        for frame in sequence:
            T_odom_cam = odometry.place(frame)
            poses.write(tum_line(frame.timestamp_s, T_odom_cam))
            slam.process(frame, T_odom_cam)
    if odometry.failed:
        print(f"Open3D found no motion for {odometry.failed} images; the last one went on there")
    return slam.finish()


def main(name: str, poses_file: str = "open3d_odometry.txt") -> None:
    """Run on one sequence and print how much of the drift went away."""
    sequence = open_sequence(resolve(name), CONFIG.input)
    result = close_loops(sequence, Path(poses_file))
    given = result.given
    closed = sum(attempt.rejection is None for attempt in result.attempts)
    print(f"{len(given.given)} poses in {poses_file}")
    print(f"{len(result.keyframes)} keyframes, {closed} of {len(result.attempts)} loops closed")
    print(given.verdict, *result.warnings, sep="\n")
    if sequence.ground_truth:
        every_pose = replace(result, odometry=given.given, trajectory=given.corrected)
        drift = compare_drift(every_pose, sequence.ground_truth, CONFIG.evaluation)
        print(f"ATE {drift.odometry.ate_rmse_m:.4f} m -> {drift.corrected.ate_rmse_m:.4f} m")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:3])
    except LoopcloseError as error:
        sys.exit(str(error))
