# SPDX-License-Identifier: Apache-2.0
"""Close loops on the poses of another odometry: yours, say, in a TUM trajectory file.

    python examples/poses_from_elsewhere.py SEQUENCE [YOUR_ODOMETRY.txt]

Only the images are taken from the sequence; nothing is tracked. Without a file, ground truth with
added drift stands in for an odometry. T_a_b takes coordinates in b to coordinates in a.
"""

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
    read_tum,
)
from slam.datasets import Sequence, resolve

KEYFRAME_M, KEYFRAME_DEG = 0.2, 15.0
MAX_TIME_DIFFERENCE_S = 0.02
CONFIG = Config(
    graph={
        # How far off your odometry is from one keyframe to the next: with less, loops that ask for
        # a larger correction are outvoted; with more, they may bend good odometry.
        "outside_rotation_sigma_deg": 1.0,
        "outside_translation_sigma_m": 0.02,
    }
)
Transform = NDArray[np.float64]  # (4, 4)


def close_loops(sequence: Sequence, odometry: Trajectory) -> SlamResult:
    """Hand every keyframe with its odometry pose to `Slam`, and let it correct them."""
    slam = Slam(sequence.camera, load("learned"), CONFIG)
    for image, T_odom_cam in keyframes(sequence, odometry):
        slam.add_keyframe(sequence.frame(image), T_odom_cam)
    return slam.finish()


def keyframes(sequence: Sequence, odometry: Trajectory) -> list[tuple[int, Transform]]:
    """Pick the images, by index, before which the camera has moved or turned far enough."""
    chosen: list[tuple[int, Transform]] = []
    for image, time_s in enumerate(sequence.timestamps_s):
        difference_s = np.abs(odometry.timestamps_s - time_s)
        T_odom_cam = odometry.T_world_cam[difference_s.argmin()]
        if difference_s.min() <= MAX_TIME_DIFFERENCE_S and (
            not chosen or is_far(np.linalg.inv(chosen[-1][1]) @ T_odom_cam)
        ):
            chosen.append((image, T_odom_cam))
    if not chosen:
        raise SlamError("no image was taken within 20 ms of a pose; do both use one clock?")
    return chosen


def is_far(T_last_cam: Transform) -> bool:
    """Return whether a camera that moved like this starts a new keyframe."""
    moved_m = np.linalg.norm(T_last_cam[:3, 3])
    turned_deg = np.degrees(Rotation.from_matrix(T_last_cam[:3, :3]).magnitude())
    return bool(moved_m > KEYFRAME_M or turned_deg > KEYFRAME_DEG)


def corrected(odometry: Trajectory, result: SlamResult) -> Trajectory:
    """Return every pose of the odometry, corrected as the last keyframe before it was."""
    T_odom_kf = np.array([keyframe.T_odom_cam for keyframe in result.keyframes])
    T_world_odom = result.T_world_kf @ np.linalg.inv(T_odom_kf)
    stamps_s = [keyframe.timestamp_s for keyframe in result.keyframes]
    last = np.searchsorted(stamps_s, odometry.timestamps_s, side="right") - 1
    return Trajectory(
        odometry.timestamps_s, T_world_odom[np.maximum(last, 0)] @ odometry.T_world_cam
    )


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
    print(*result.warnings, sep="\n", end="\n" if result.warnings else "")
    if truth:
        every_pose = replace(result, odometry=odometry, trajectory=corrected(odometry, result))
        drift = compare_drift(every_pose, truth, CONFIG.evaluation)
        print(f"ATE {drift.odometry.ate_rmse_m:.4f} m -> {drift.corrected.ate_rmse_m:.4f} m")


if __name__ == "__main__":
    try:
        main(*sys.argv[1:3])
    except LoopcloseError as error:
        sys.exit(str(error))
