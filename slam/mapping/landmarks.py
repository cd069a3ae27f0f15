# SPDX-License-Identifier: Apache-2.0
"""Points in space that several keyframes see, kept as columns of a growing table."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from placerec.compiled import compiled
from slam.types import FloatArray, IntArray

UNSEEN = -1
"""What stands for no landmark, and for no keyframe, among their ids."""
_OBSERVERS = 8  # keyframes remembered per landmark; more would not change which are covisible
_SPARE_ROWS = 1 << 16
_FAR_APART = 64  # times as many ids as are asked for: sorting those is then less work


class Landmarks:
    """A table of landmarks; an id is a row, and rows never move.

    Two of three landmarks are soon gone. Once nobody knows their ids any more, their rows become
    those of others, before the table grows.

    Attributes:
        positions_m: (P, 3) float64, odometry frame.
        descriptors: (P, 32) uint8, as last seen by a keyframe.
        octaves, distances_m: (P,) pyramid level and distance at which it was last seen.
        directions: (P, 3) float32 unit vectors, from which it was last seen, odometry frame.
        observers: (P, 8) int32 ids of the keyframes that saw it last, UNSEEN where fewer did.
        first_keyframe: (P,) id of the keyframe that created it.
        sightings: (P,) how many keyframes saw it.
        is_alive: (P,) bool; culled and merged ones are not.
    """

    def __init__(self) -> None:
        self._count = 0
        self.positions_m = np.zeros((0, 3))
        self.descriptors = np.zeros((0, 32), dtype=np.uint8)
        self.octaves = np.zeros(0, dtype=np.uint8)
        self.distances_m = np.zeros(0, dtype=np.float32)
        self.directions = np.zeros((0, 3), dtype=np.float32)
        self.observers = np.zeros((0, _OBSERVERS), dtype=np.int32)
        self.first_keyframe = np.zeros(0, dtype=np.int32)
        self.sightings = np.zeros(0, dtype=np.int32)
        self.is_alive = np.zeros(0, dtype=bool)
        self._merged_into = np.zeros(0, dtype=np.int32)
        self._unused: list[int] = []

    @classmethod
    def of(cls, **columns: NDArray[Any]) -> "Landmarks":
        """Return a table of (P, ...) columns, by name, which may lie in a file; all are alive."""
        table, count = cls(), len(columns["positions_m"])
        for name, column in columns.items():
            own = getattr(table, name)
            if column.dtype != own.dtype or column.shape != (count, *own.shape[1:]):
                raise ValueError(f"landmarks' {name}")
            setattr(table, name, column)
        table._count, table.is_alive = count, np.ones(count, bool)
        table._merged_into = np.arange(count, dtype=np.int32)
        return table

    def __len__(self) -> int:
        return self._count

    def add(self, positions_m: FloatArray, keyframe_id: int) -> IntArray:
        """Add landmarks at (N, 3) positions and return their ids; `see` has to follow."""
        ids = self._rows(len(positions_m))
        self.positions_m[ids] = positions_m
        self.observers[ids] = UNSEEN
        self.sightings[ids] = 0
        self.first_keyframe[ids] = keyframe_id
        self.is_alive[ids] = True
        self._merged_into[ids] = ids
        return ids

    def _rows(self, count: int) -> IntArray:
        """Return rows for so many landmarks."""
        missing = self._count + count - len(self.is_alive)
        again = self._unused[: max(missing, 0)]
        if len(again) < missing:
            again = []
            self._grow(self._count + count + _SPARE_ROWS)
        del self._unused[: len(again)]
        first, self._count = self._count, self._count + count - len(again)
        return np.concatenate([np.array(again, np.int64), np.arange(first, self._count)])

    def _grow(self, rows: int) -> None:
        # In place the system moves pages instead of bytes, so that a large map need not hold up
        # the camera. That takes columns which nobody looks at.
        columns = [name for name, value in vars(self).items() if isinstance(value, np.ndarray)]
        for name in columns:
            shape = (rows, *getattr(self, name).shape[1:])
            try:
                getattr(self, name).resize(shape)
            except ValueError:
                column = getattr(self, name)
                more = np.zeros((rows - len(column), *shape[1:]), column.dtype)
                setattr(self, name, np.concatenate([column, more]))

    def see(
        self,
        ids: IntArray,
        keyframe_id: int,
        centre_m: FloatArray,
        descriptors: NDArray[np.uint8],
        octaves: IntArray,
    ) -> None:
        """Note that a keyframe with its camera at a (3,) centre sees landmarks."""
        rays = self.positions_m[ids] - centre_m
        distances_m = np.linalg.norm(rays, axis=1)
        newest = keyframe_id >= self.observers[ids].max(axis=1)
        new = ids[newest]
        self.descriptors[new] = descriptors[newest]
        self.octaves[new] = octaves[newest]
        self.distances_m[new] = distances_m[newest]
        self.directions[new] = rays[newest] / distances_m[newest][:, None]
        self.observers[ids, self.sightings[ids] % _OBSERVERS] = keyframe_id
        self.sightings[ids] += 1

    def cull(self, ids: IntArray) -> None:
        """Let landmarks be none."""
        self.is_alive[ids] = False

    def give_up(self, ids: IntArray) -> None:
        """Let rows of landmarks that are gone, and that nobody knows any more, become others."""
        self._unused.extend(ids.tolist())

    def merge(self, gone: IntArray, kept: IntArray) -> None:
        """Let (N,) landmarks be others from now on, unless a keyframe tells the two apart."""
        seen_by_gone, seen_by_kept = self.observers[gone], self.observers[kept]
        is_same = seen_by_gone[:, :, None] == seen_by_kept[:, None, :]
        is_told_apart = (is_same & (seen_by_gone != UNSEEN)[:, :, None]).any(axis=(1, 2))
        gone, kept = gone[~is_told_apart], kept[~is_told_apart]
        self._merged_into[gone] = kept
        self.is_alive[gone] = False
        np.add.at(self.sightings, kept, self.sightings[gone])

    def resolve(self, ids: IntArray | NDArray[np.int32]) -> IntArray:
        """Return what became of landmarks: themselves, those they were merged into, or UNSEEN."""
        return _resolved(np.asarray(ids, np.int32), self._merged_into, self.is_alive)

    def distinct(self, ids: IntArray | NDArray[np.int32]) -> IntArray:
        """Return the same, each once, in order, and without UNSEEN."""
        return _distinct(_resolved(np.asarray(ids, np.int32), self._merged_into, self.is_alive))


def is_among(ids: IntArray | NDArray[np.int32], others: IntArray) -> NDArray[np.bool_]:
    """Return (N,) whether each of the ids is among others, which are in order."""
    # What is of another kind, or laid out in another way, would be compiled for anew.
    return _is_among(np.ascontiguousarray(ids, np.int64), np.ascontiguousarray(others, np.int64))


@compiled
def _is_among(ids: IntArray, others: IntArray) -> NDArray[np.bool_]:
    is_there = np.zeros(len(ids), np.bool_)
    places = np.searchsorted(others, ids)
    for i in range(len(ids)):
        is_there[i] = places[i] < len(others) and others[places[i]] == ids[i]
    return is_there


@compiled
def _distinct(ids: IntArray) -> IntArray:
    """Return those of (N,) ids that are not UNSEEN, each once, in order."""
    known: IntArray = ids[ids != UNSEEN]
    if not len(known):
        return known
    first, last = known.min(), known.max()
    if last - first >= _FAR_APART * len(known):
        return np.unique(known)
    is_there = np.zeros(last - first + 1, np.bool_)
    for each in known:
        is_there[each - first] = True
    distinct: IntArray = np.flatnonzero(is_there) + first
    return distinct


@compiled
def _resolved(
    ids: NDArray[np.int32], merged_into: NDArray[np.int32], is_alive: NDArray[np.bool_]
) -> IntArray:
    resolved = np.full(len(ids), UNSEEN, np.int64)
    for i in range(len(ids)):
        known = ids[i]
        if known < 0:
            continue
        while merged_into[known] != known:
            known = merged_into[known]
        if is_alive[known]:
            resolved[i] = known
    return resolved
