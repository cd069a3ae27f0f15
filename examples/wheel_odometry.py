# SPDX-License-Identifier: Apache-2.0
"""Close loops on a planar wheel odometry: `time x y yaw` of a robot's base_link.

    python examples/wheel_odometry.py SEQUENCE                   where the camera is, is found out
    python examples/wheel_odometry.py SEQUENCE --mount known     it is told

There is no recording of a robot here, so the wheels are made up from the ground truth of any
sequence whose world has z up: base_link (x ahead, z up) is below and behind the camera, turned to
where the camera looks, in the plane. Hands nod, roll and lift a camera, which no wheel knows of; a
robot on a floor does less of it. Then the wheels slip. What is run is what

    run_slam SEQUENCE --odometry wheels.txt --odometry.T-base-cam auto

does, in Python.
"""

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from placerec import load
from slam import (
    Config,
    LoopcloseError,
    Slam,
    SlamError,
    SlamResult,
    Trajectory,
    compare_drift,
    open_sequence,
)
from slam.datasets import Sequence, resolve

Array = NDArray[np.float64]

ARM_M = np.array([0.20, 0.05, 0.40])  # from base_link to the camera: ahead, to the left, up
TURN_ERROR, SLIP = 0.04, 0.10  # share of each turn, always; of each step and turn, at random


def mount(truth: Trajectory) -> Array:
    """Return (4, 4) T_base_cam: ahead, and as much down as the camera looks most of the time."""
    down = np.median(np.arcsin(-truth.T_world_cam[:, 2, 2]))
    T_base_cam = np.eye(4)
    ahead = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T_base_cam[:3, :3] = Rotation.from_rotvec([0.0, down, 0.0]).as_matrix() @ ahead
    T_base_cam[:3, 3] = ARM_M
    return T_base_cam


def flat(truth: Trajectory) -> Array:
    """Return (N, 3) x, y and yaw of base_link: turned to where the camera looks."""
    ahead, at = truth.T_world_cam[:, :2, 2], truth.T_world_cam[:, :2, 3]
    yaw = np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))
    return np.column_stack([at - turned(yaw, ARM_M[:2]), yaw])


def turned(yaw: Array, way: Array) -> Array:
    """Return (N, 2) ways, or the same one, each turned by its angle."""
    c, s = np.cos(yaw), np.sin(yaw)
    x, y = way[..., 0], way[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def slipping(poses: Array, seed: int = 0) -> Array:
    """Return what wheels make of (N, 3) poses: x, y and yaw, each step from the one before."""
    rng = np.random.default_rng(seed)
    steps = np.diff(poses, axis=0)
    ways, turns = turned(-poses[:-1, 2], steps[:, :2]), steps[:, 2]
    ways = ways * (1.0 + SLIP * rng.normal(size=(len(ways), 1)))
    turns = turns * (1.0 + TURN_ERROR + SLIP * rng.normal(size=len(turns)))
    yaw = poses[0, 2] + np.concatenate([[0.0], np.cumsum(turns)])
    at = poses[0, :2] + np.concatenate([np.zeros((1, 2)), np.cumsum(turned(yaw[:-1], ways), 0)])
    return np.column_stack([at, yaw])


def in_space(timestamps_s: Array, poses: Array) -> Trajectory:
    """Return (N, 3) x, y, yaw as the poses that `Slam` takes."""
    T_odom_base = np.tile(np.eye(4), (len(poses), 1, 1))
    T_odom_base[:, :3, :3] = Rotation.from_euler("z", poses[:, 2:]).as_matrix()
    T_odom_base[:, :2, 3] = poses[:, :2]
    return Trajectory(timestamps_s, T_odom_base)


def write_planar(file: Path, timestamps_s: Array, poses: Array) -> None:
    """Write `time x y yaw` lines, which `run_slam --odometry` reads."""
    lines = [
        f"{time_s:.6f} {x:.6f} {y:.6f} {yaw:.6f}\n"
        for time_s, (x, y, yaw) in zip(timestamps_s, poses, strict=True)
    ]
    file.write_text("".join(lines))


def close_loops(
    sequence: Sequence, wheels: Trajectory, T_base_cam: Array | None = None
) -> SlamResult:
    """Hand every image, and the wheels' poses until then, to `Slam`; without a mount find it."""
    told: str | tuple[float, ...] = "auto"
    if T_base_cam is not None:
        quaternion = Rotation.from_matrix(T_base_cam[:3, :3]).as_quat()
        told = (*T_base_cam[:3, 3].tolist(), *quaternion.tolist())
    config = Config.model_validate({"odometry": {"T_base_cam": told}})
    slam = Slam(sequence.camera, load("learned"), config)
    poses = zip(wheels.timestamps_s.tolist(), wheels.T_world_cam, strict=True)
    last_s = -np.inf
    for frame in sequence:
        # One pose more than those until then: the image's lies between two.
        while last_s <= frame.timestamp_s and (pose := next(poses, None)):
            slam.add_pose(*pose)
            last_s = pose[0]
        slam.process(frame)
    for pose in poses:
        slam.add_pose(*pose)
    return slam.finish()


def main(arguments: list[str] | None = None) -> None:
    """Make up the wheels, run, and print how much of their drift went away."""
    parser = argparse.ArgumentParser(description="Close loops on a planar wheel odometry.")
    parser.add_argument("sequence", help="recording with ground truth, named as for run_slam")
    parser.add_argument("--mount", choices=["auto", "known"], default="auto")
    parser.add_argument("--wheels", type=Path, default=Path("wheels.txt"), metavar="FILE")
    told = parser.parse_args(arguments)
    sequence = open_sequence(resolve(told.sequence), Config().input)
    truth = sequence.ground_truth
    if truth is None:
        raise SlamError("there is no ground truth to make wheels up from; choose another sequence")
    poses, T_base_cam = flat(truth), mount(truth)
    slipped = slipping(poses)
    write_planar(told.wheels, truth.timestamps_s, slipped)
    wheels = in_space(truth.timestamps_s, slipped)
    result = close_loops(sequence, wheels, None if told.mount == "auto" else T_base_cam)
    print(f"{len(wheels)} poses in {told.wheels}, true mount:", *np.round(T_base_cam[:3, 3], 3))
    print(result.given.verdict, *result.warnings, sep="\n")
    of_camera = compare_drift(result, truth, Config().evaluation)
    of_base = compare_drift(
        replace(result, odometry=wheels, trajectory=result.given.corrected),
        in_space(truth.timestamps_s, poses),
        Config().evaluation,
    )
    for name, drift in (("camera", of_camera), ("base_link", of_base)):
        before, after = drift.odometry.ate_rmse_m, drift.corrected.ate_rmse_m
        print(f"ATE of the {name}: {before:.4f} m -> {after:.4f} m")


if __name__ == "__main__":
    try:
        main()
    except LoopcloseError as error:
        sys.exit(str(error))
