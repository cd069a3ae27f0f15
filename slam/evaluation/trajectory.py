# SPDX-License-Identifier: Apache-2.0
"""Trajectories: TUM files, poses and pairs in time, and alignment in space."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.datasets.tum_lists import POSE_COLUMNS, nearest, read_poses
from placerec.files import write_atomically
from slam.geometry import se3
from slam.types import FloatArray, IntArray, SlamError, Trajectory

_FARTHEST = 1e12  # no distance on Earth is larger, in whatever unit


def read_tum(path: Path) -> Trajectory:
    """Read a trajectory in the TUM format: a pose per line, `#` starts a comment line.

    Raises:
        LoopcloseError: the file cannot be read, holds no pose, or a line is not a pose later than
            the one before; the message names the line.
    """
    rows: list[list[float]] = []
    for number, pose in read_poses(path):
        if rows and pose[0] <= rows[-1][0]:
            raise SlamError(
                f"line {number} of the trajectory: timestamp {pose[0]:.6f} is not after the one"
                f" before it, {rows[-1][0]:.6f}; sort the lines by time, one per timestamp: {path}"
            )
        rows.append(pose)
    if not rows:
        raise SlamError(
            f"the trajectory holds no poses; expected lines of `{POSE_COLUMNS}`: {path}"
        )
    return from_rows(np.array(rows))


def from_rows(rows: FloatArray) -> Trajectory:
    """Return the trajectory of (N, 8) rows of the TUM format, in increasing order of time."""
    T_world_cam = np.tile(np.eye(4), (len(rows), 1, 1))
    T_world_cam[:, :3, 3] = rows[:, 1:4]
    T_world_cam[:, :3, :3] = se3.from_quaternion(rows[:, 4:])
    return Trajectory(rows[:, 0], T_world_cam)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Write a trajectory in the TUM format; the same poses always give the same bytes.

    Raises:
        LoopcloseError: the file cannot be written.
    """
    write_atomically(path, "\n".join(tum_lines(trajectory)) + "\n")


def tum_lines(trajectory: Trajectory) -> list[str]:
    """Return a trajectory in the TUM format: the names of the columns, then a line per pose."""
    quaternions = se3.to_quaternion(trajectory.T_world_cam[:, :3, :3])
    # Adding 0.0 turns a rounded -0.0 into 0.0.
    poses = np.round(np.hstack([trajectory.T_world_cam[:, :3, 3], quaternions]), 9) + 0.0
    lines = [f"# {POSE_COLUMNS}"]
    for timestamp_s, pose in zip(trajectory.timestamps_s, poses.tolist(), strict=True):
        lines.append(" ".join([f"{timestamp_s:.6f}", *(f"{value:.9f}" for value in pose)]))
    return lines


def placeable(trajectory: Trajectory) -> NDArray[np.bool_]:
    """Return (N,) whether poses hold numbers that a place can have; others overflow, or are NaN."""
    return np.asarray((np.abs(trajectory.T_world_cam) < _FARTHEST).all(axis=(1, 2)))


def associate(a: Trajectory, b: Trajectory, tolerance_s: float) -> tuple[IntArray, IntArray]:
    """Pair poses of two trajectories that are nearest in time, closest pairs first.

    Returns:
        (M,) indices into a, increasing, and (M,) into b: each pose is used once at most, and no
        pair is further apart than the tolerance.
    """
    free_a = np.arange(len(a), dtype=np.int64)
    free_b = np.arange(len(b), dtype=np.int64)
    pairs: list[tuple[IntArray, IntArray]] = [(free_a[:0], free_b[:0])]
    # Two poses that are nearest to each other are a pair that no closer one can break up; taking
    # all of these at a time gives what taking the globally closest one by one would.
    while len(free_a) and len(free_b):
        stamps_a, stamps_b = a.timestamps_s[free_a], b.timestamps_s[free_b]
        to_b = nearest(stamps_b, stamps_a)
        is_pair = nearest(stamps_a, stamps_b)[to_b] == np.arange(len(free_a))
        is_pair &= np.abs(stamps_a - stamps_b[to_b]) <= tolerance_s
        if not is_pair.any():
            break
        pairs.append((free_a[is_pair], free_b[to_b[is_pair]]))
        free_b = np.delete(free_b, to_b[is_pair])
        free_a = free_a[~is_pair]
    indices_a = np.concatenate([pair[0] for pair in pairs])
    indices_b = np.concatenate([pair[1] for pair in pairs])
    order = np.argsort(indices_a)
    return indices_a[order], indices_b[order]


def poses_at(trajectory: Trajectory, stamps_s: FloatArray, tolerance_s: float) -> FloatArray:
    """Return the (N, 4, 4) poses at (N,) times, NaN where none is within the tolerance.

    Between two poses that both are, the camera is taken to have moved steadily; else the nearest
    one's is returned. A camera that turns by 100 degrees a second turns by half a degree in the
    5 ms that the nearest pose of a tracker with 100 Hz may be away.
    """
    T_world_cam = np.full((len(stamps_s), 4, 4), np.nan)
    if len(trajectory) == 0 or len(stamps_s) == 0:
        return T_world_cam
    known_s, poses = trajectory.timestamps_s, trajectory.T_world_cam
    closest = nearest(known_s, stamps_s)
    is_near = np.abs(known_s[closest] - stamps_s) <= tolerance_s
    T_world_cam[is_near] = poses[closest[is_near]]
    after = np.searchsorted(known_s, stamps_s)
    within = np.flatnonzero((after > 0) & (after < len(known_s)))
    gap_s = np.maximum(
        known_s[after[within]] - stamps_s[within], stamps_s[within] - known_s[after[within] - 1]
    )
    within = within[gap_s <= tolerance_s]
    second = after[within]
    first = second - 1
    share = (stamps_s[within] - known_s[first]) / (known_s[second] - known_s[first])
    motion = se3.log(se3.inverse(poses[first]) @ poses[second])
    T_world_cam[within] = poses[first] @ se3.exp(share[:, None] * motion)
    return T_world_cam


MIN_ALIGNED = 3
"""Fewer positions do not fix an alignment in space."""


def align(estimate_m: FloatArray, truth_m: FloatArray) -> FloatArray:
    """Return T_truth_world, the (4, 4) rigid motion without scale that best lays points on points.

    Horn's closed-form least squares between (N, 3) positions in metres. Fewer than three points,
    or points on a line, leave a rotation free: any of the best ones is returned.

    Raises:
        SlamError: there is no point at all.
    """
    if len(estimate_m) == 0:
        raise SlamError("cannot align two trajectories that have no pose in common")
    centre_estimate, centre_truth = estimate_m.mean(axis=0), truth_m.mean(axis=0)
    R_truth_world = se3.rotation_between(estimate_m - centre_estimate, truth_m - centre_truth)
    return se3.from_rotation_translation(
        R_truth_world, centre_truth - R_truth_world @ centre_estimate
    )


def scale_between(aligned_m: FloatArray, truth_m: FloatArray) -> float:
    """Return how many times as large (N, 3) aligned positions have to be to lie on the truth best.

    With `align` this is the similarity of Umeyama (1991). NaN where they are all in one place.
    """
    from_centre_m = aligned_m - aligned_m.mean(axis=0)
    spread = float((from_centre_m**2).sum())
    fitting = float((from_centre_m * (truth_m - truth_m.mean(axis=0))).sum())
    return fitting / spread if spread > 0.0 else float("nan")


def path_length_m(trajectory: Trajectory) -> float:
    """Return the length of the straight lines between consecutive positions, metres."""
    steps = np.diff(trajectory.T_world_cam[:, :3, 3], axis=0)
    return float(np.linalg.norm(steps, axis=1).sum())
