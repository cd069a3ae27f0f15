# SPDX-License-Identifier: Apache-2.0
"""Close loops on the poses of another odometry: yours, say, in a TUM trajectory file.

    python examples/poses_from_elsewhere.py SEQUENCE [YOUR_ODOMETRY.txt]

What `run_slam SEQUENCE --odometry YOUR_ODOMETRY.txt` does, in Python. Without a file, ground truth
with added drift stands in for an odometry.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
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
    read_tum,
)
from slam.datasets import Sequence, resolve

CONFIG = Config()


def close_loops(sequence: Sequence, odometry: Trajectory) -> SlamResult:
    """Hand every image, and all poses until then, to `Slam`; let it correct the poses."""
    slam = Slam(sequence.camera, load("learned"), CONFIG)
    poses = zip(odometry.timestamps_s.tolist(), odometry.T_world_cam, strict=True)
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


def drifting(truth: Trajectory, seed: int = 0) -> Trajectory:
    """Return what a poor odometry makes of the truth: every step is a little off, and it adds up.

    Part of the error is constant, as that of a wrong calibration: about 0.4 degrees and 15 mm a
    second.
    """
    rng = np.random.default_rng(seed)
    unit = np.repeat([np.radians(0.25), 0.009], 3)  # rotation in rad, then translation in metres
    bias = rng.normal(size=6)
    steps = np.linalg.inv(truth.T_world_cam[:-1]) @ truth.T_world_cam[1:]
    T_odom_cam = [truth.T_world_cam[0]]
    for T_before_after, seconds in zip(steps, np.diff(truth.timestamps_s), strict=True):
        noise = 0.3 * np.sqrt(seconds) * rng.normal(size=6)
        error = unit * (seconds * bias + noise)
        T_after_measured = np.eye(4)
        T_after_measured[:3, :3] = Rotation.from_rotvec(error[:3]).as_matrix()
        T_after_measured[:3, 3] = error[3:]
        T_odom_cam.append(T_odom_cam[-1] @ T_before_after @ T_after_measured)
    return Trajectory(truth.timestamps_s, np.array(T_odom_cam))


def main(name: str, odometry_file: str | None = None) -> None:
    """Run on one sequence and print how much of the drift went away."""
    sequence = open_sequence(resolve(name), CONFIG.input)
    truth = sequence.ground_truth
    if odometry_file:
        odometry = read_tum(Path(odometry_file))
    elif truth:
        odometry = drifting(truth)
    else:
        raise SlamError("there is no ground truth to add drift to; give an odometry file")
    result = close_loops(sequence, odometry)
    closed = sum(attempt.rejection is None for attempt in result.attempts)
    print(f"{len(result.keyframes)} keyframes, {closed} of {len(result.attempts)} loops closed")
    print(result.given.verdict, *result.warnings, sep="\n")
    if truth:
        every_pose = replace(result, odometry=odometry, trajectory=result.given.corrected)
        drift = compare_drift(every_pose, truth, CONFIG.evaluation)
        print(f"ATE {drift.odometry.ate_rmse_m:.4f} m -> {drift.corrected.ate_rmse_m:.4f} m")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:3])
    except LoopcloseError as error:
        sys.exit(str(error))
