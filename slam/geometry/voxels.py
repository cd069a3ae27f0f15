# SPDX-License-Identifier: Apache-2.0
"""Points added up by the voxel they are in, which an open hash table finds."""

import numpy as np
from numpy.typing import NDArray

from placerec.compiled import compiled, inlined
from slam.types import FloatArray

# What a step to the next voxel along each axis adds to a voxel's number, which wraps around, and
# what spreads the numbers over the table.
_ALONG_X, _ALONG_Y, _ALONG_Z, _SPREADING = (
    np.uint64(0x9E3779B97F4A7C15),
    np.uint64(0xC2B2AE3D27D4EB4F),
    np.uint64(0x165667B19E3779F9),
    np.uint64(0xD6E8FEB86659FD93),
)
_EMPTY = -1


def hash_table(numbers: NDArray[np.uint64], room: int) -> NDArray[np.int32]:
    """Return a table of the rows of (N,) numbers that are all different, for `room` of them."""
    table = np.full(1 << (2 * max(room, 1) - 1).bit_length(), _EMPTY, np.int32)
    _fill(table, numbers)
    return table


@inlined
def _slot_of(table: NDArray[np.int32], numbers: NDArray[np.uint64], number: np.uint64) -> int:
    """Return where a number's row stands, or would stand."""
    last = len(table) - 1
    slot = int((number * _SPREADING) >> np.uint64(32)) & last
    while table[slot] != _EMPTY and numbers[table[slot]] != number:
        slot = (slot + 1) & last
    return slot


@compiled
def _fill(table: NDArray[np.int32], numbers: NDArray[np.uint64]) -> None:
    for row in range(len(numbers)):
        table[_slot_of(table, numbers, numbers[row])] = row


@compiled
def voxel_numbers(points_m: FloatArray, voxel_m: float) -> NDArray[np.uint64]:
    """Return (N,) numbers that tell the voxels of (N, 3) points apart.

    But for one in 10^8 of all maps.
    """
    numbers = np.zeros(len(points_m), np.uint64)
    for i in range(len(points_m)):
        for axis, step in ((0, _ALONG_X), (1, _ALONG_Y), (2, _ALONG_Z)):
            numbers[i] += np.uint64(np.int64(np.floor(points_m[i, axis] / voxel_m))) * step
    return numbers


@compiled
def add_to_voxels(
    numbers: NDArray[np.uint64],
    points_m: FloatArray,
    values: NDArray[np.float32],
    table: NDArray[np.int32],
    known: NDArray[np.uint64],
    sums_m: FloatArray,
    sums: NDArray[np.float32],
    count: int,
) -> int:
    """Add (N, 3) points and (N, V) values to the sums of the voxels with (N,) numbers.

    Of the (R,) known numbers, (R, 3) and (R, V) sums `count` are taken: returns how many are now.
    They and the table have room for all of the N to be new.
    """
    for i in range(len(numbers)):
        slot = _slot_of(table, known, numbers[i])
        if table[slot] == _EMPTY:
            table[slot], known[count] = count, numbers[i]
            count += 1
        row = table[slot]
        for axis in range(3):
            sums_m[row, axis] += points_m[i, axis]
        for column in range(values.shape[1]):
            sums[row, column] += values[i, column]
    return count
