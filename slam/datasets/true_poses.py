# SPDX-License-Identifier: Apache-2.0
"""True camera poses, in the ways that recordings write them down."""

from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from placerec.datasets.times import Clock, in_order, like_images
from placerec.datasets.tum_lists import as_numbers, read_lines, read_poses
from slam.evaluation.trajectory import from_rows, placeable
from slam.geometry import se3
from slam.types import FloatArray, SlamError, Trajectory

_MAX_SKEW = 1e-2  # files with few digits are no exact rotations; a scale or a shear is none at all


def read_pose_list(
    file: Path,
    warnings: list[str],
    images_s: FloatArray | None = None,
    clock: Clock | None = None,
) -> Trajectory | None:
    """Read a pose per line, `timestamp tx ty tz qx qy qz qw`, or None where there is no line.

    Lines that say that the pose is not known are gaps. Where the (N,) times of the images as
    listed, seconds, and their clock are given, those of the poses are made to be by the same.

    Raises:
        LoopcloseError: a line is no pose.
    """
    rows = [pose for _, pose in read_poses(file, with_gaps=True)]
    if not rows:
        warnings.append(f"{file.name} holds no pose, so there is no ground truth")
        return None
    table = np.array(rows)
    if images_s is not None:
        table[:, 0] = like_images(table[:, 0], images_s, file, warnings)
    kept, times_s, _ = in_order(table[:, 0], file, warnings, clock)
    poses = from_rows(np.column_stack([times_s, table[kept, 1:]]))
    return known_poses(poses, file, warnings)


def known_poses(poses: Trajectory, file: Path, warnings: list[str]) -> Trajectory | None:
    """Return the poses that a camera can have, None without any; a warning counts the others."""
    is_known = placeable(poses)
    if is_known.all():
        return poses
    warnings.append(
        f"{int((~is_known).sum())} of {len(poses)} poses of {file.name} hold no numbers that a"
        " place can have; they are gaps in the ground truth"
    )
    if not is_known.any():
        return None
    return Trajectory(poses.timestamps_s[is_known], poses.T_world_cam[is_known])


def read_pose_files(files: Iterable[tuple[float, Path]], warnings: list[str]) -> Trajectory | None:
    """Read a (4, 4) matrix per file, given with its time, or None where no frame has a pose.

    A file that is missing, or holds no number or zeros alone, means that the pose is not known.

    Raises:
        LoopcloseError: a file holds something else than a rigid pose.
    """
    stamps_s: list[float] = []
    T_world_cam: list[FloatArray] = []
    unknown = 0
    for timestamp_s, file in files:
        T = read_matrix(file) if file.is_file() else None
        if T is None or is_gap(T):
            unknown += 1
            continue
        stamps_s.append(timestamp_s)
        T_world_cam.append(rigid(T, "the pose", file))
    if unknown:
        total = unknown + len(stamps_s)
        warnings.append(
            f"{unknown} of {total} frames have no true pose (no file, or no number in it)"
        )
    return Trajectory(np.array(stamps_s), np.array(T_world_cam)) if stamps_s else None


def is_gap(T: FloatArray) -> bool:
    """Return whether a (4, 4) matrix says that the pose is not known: no numbers, or all zeros."""
    return not np.isfinite(T).all() or not T[:3].any()


def read_pose_log(file: Path) -> list[tuple[int, FloatArray]]:
    """Read (frame number, T_world_cam) from a .log: a line `i j k`, then a (4, 4) matrix each.

    One that is not known is of NaN.

    Raises:
        LoopcloseError: a block is not complete, or is no rigid pose.
    """
    poses = []
    lines = read_lines(file)
    for number, line in lines:
        head = as_numbers(line)
        if head is None or len(head) != 3 or head[0] != int(head[0]):
            raise SlamError(f'line {number} is not "i j k", whole numbers: {line!r}: {file}')
        T = _next_matrix(lines, number, file)
        poses.append((int(head[0]), rigid_or_gap(T, f"the pose after line {number}", file)))
    return poses


def _next_matrix(lines: Iterator[tuple[int, str]], after: int, file: Path) -> FloatArray:
    rows = [line.split() for _, (_, line) in zip(range(4), lines, strict=False)]
    try:
        return np.array(rows, dtype=np.float64).reshape(4, 4)
    except ValueError as error:
        raise SlamError(
            f"after line {after} there are not four rows of four numbers, a pose: {file}"
        ) from error


def read_matrix(file: Path, size: int = 4) -> FloatArray:
    """Read a text file that holds a square matrix and nothing else; infinite values come as such.

    Raises:
        LoopcloseError: it holds something else.
    """
    text = " ".join(line for _, line in read_lines(file))
    try:
        values = [float(field) for field in text.replace(",", " ").split()]
    except ValueError:
        values = []
    if len(values) != size**2:
        raise SlamError(f"the file does not hold a matrix of {size} x {size} numbers: {file}")
    return np.array(values).reshape(size, size)


def rigid_or_gap(T_a_b: FloatArray, what: str, file: Path) -> FloatArray:
    """Return the same as `rigid`, and NaN where the pose is not known.

    Raises:
        SlamError: it is neither.
    """
    return np.full((4, 4), np.nan) if is_gap(T_a_b) else rigid(T_a_b, what, file)


def rigid(T_a_b: FloatArray, what: str, file: Path) -> FloatArray:
    """Return the (4, 4) matrix as an exact rigid transform, free of the rounding in its file.

    Raises:
        SlamError: it is none; the message says `what` it was to be.
    """
    if not np.isfinite(T_a_b).all():
        raise SlamError(f"{what} holds a number that is not finite: {file}")
    R = T_a_b[:3, :3]
    skew = np.abs(R @ R.T - np.eye(3)).max()
    is_affine = np.allclose(T_a_b[3], [0.0, 0.0, 0.0, 1.0], atol=1e-6)
    if skew > _MAX_SKEW or np.linalg.det(R) < 0.0 or not is_affine:
        raise SlamError(
            f"{what} is no rotation and translation (R R' is off the identity by {skew:.2g},"
            f" det R = {np.linalg.det(R):.2g}, last row {T_a_b[3].tolist()}): {file}"
        )
    U, _, Vt = np.linalg.svd(R)
    return se3.from_rotation_translation(U @ Vt, T_a_b[:3, 3])
