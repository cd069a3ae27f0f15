# SPDX-License-Identifier: Apache-2.0
"""Embeddings made up like real ones: of rooms, each with a path that ten sessions walk along.

What an embedding shares with others of its building, its room and its place, with its neighbours in
the same session, and with none, says how much alike they are.
"""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Vectors = NDArray[np.float32]

SIZE = 1000
PLACES, SESSIONS = 100, 10  # of a room's path; that walk along it
ROOMS = 100  # of a building
WANTED = 10


@dataclass(frozen=True)
class Likeness:
    """How much alike embeddings are.

    Attributes:
        building, room, place, session, image: shares of the square of a length.
        next_place: cosine of what a place and the next one have of their own, and so of two images
            of a session.
    """

    building: float
    room: float
    place: float
    session: float
    image: float
    next_place: float


AS_LEARNED = Likeness(0.0, 0.15, 0.35, 0.3, 0.2, next_place=0.85)
"""Cosines are spread as those of the default recognizer on images of fr1_xyz and of rendered rooms.

Neighbours 0.74 in the median, another session at the same place 0.51, elsewhere in the room 0.15.
"""
MORE_ALIKE = Likeness(0.3, 0.2, 0.35, 0.1, 0.05, next_place=0.98)
"""As of a recognizer to which all rooms of a building, and all its corridors, are much the same.

Neighbours 0.95 in the median, another session at the same place 0.85, elsewhere in the room 0.57,
another room of the building 0.29: many places nearly equal the best.
"""


@functools.cache
def spread() -> Vectors:
    """Return the (SIZE, SIZE) square root of the covariance of embeddings, turned at random.

    Unlike pairs then have cosines around 0 with a deviation of 0.04.
    """
    turned, _ = np.linalg.qr(np.random.default_rng(0).standard_normal((SIZE, SIZE)))
    variances = (np.arange(SIZE) + 50.0) ** -0.9
    return np.asarray(turned * np.sqrt(variances / variances.mean())[:, None], np.float32)


def walk(rng: np.random.Generator, alike: float) -> Vectors:
    """Return (PLACES, SIZE) normal vectors, each like the one before."""
    steps = rng.standard_normal((PLACES, SIZE), np.float32)
    for k in range(1, PLACES):
        steps[k] = alike * steps[k - 1] + np.sqrt(1.0 - alike**2) * steps[k]
    return steps


def views(room: int, sessions: range, likeness: Likeness = AS_LEARNED) -> Vectors:
    """Return the (S, PLACES, SIZE) embeddings of sessions along a room's path."""
    rng = np.random.default_rng([0, room])
    shared = np.sqrt(likeness.room) * rng.standard_normal(SIZE, np.float32)
    shared = shared + np.sqrt(likeness.place) * walk(rng, likeness.next_place)
    building = np.random.default_rng([3, room // ROOMS]).standard_normal(SIZE, np.float32)
    shared = shared + np.sqrt(likeness.building) * building
    made = []
    for session in sessions:
        own = np.random.default_rng([1, room, session])
        light = np.sqrt(likeness.session * own.uniform(0.3, 1.7)) * walk(own, likeness.next_place)
        noise = np.sqrt(likeness.image * own.exponential(size=(PLACES, 1)))
        seen = shared + light + noise * own.standard_normal((PLACES, SIZE), np.float32)
        turned = seen.astype(np.float32) @ spread()
        made.append(turned / np.linalg.norm(turned, axis=1, keepdims=True))
    return np.stack(made)


def rooms_of(count: int, likeness: Likeness) -> Iterator[tuple[int, Vectors]]:
    """Yield so many rooms with their (SESSIONS, PLACES, SIZE)."""
    for room in range(count):
        yield room, views(room, range(SESSIONS), likeness)


def queries(rooms: int, count: int, likeness: Likeness) -> Vectors:
    """Return (count, SIZE) embeddings of a session that is in no store."""
    rng = np.random.default_rng(2)
    chosen = rng.permutation(rooms)[: max(1, count // 10)]
    seen = [views(int(room), range(SESSIONS, SESSIONS + 1), likeness)[0] for room in chosen]
    each = -(-count // len(seen))
    return np.concatenate([one[rng.permutation(PLACES)[:each]] for one in seen])[:count]


def name_of(room: int, session: int) -> str:
    """Return what a session is called."""
    return f"room{room}/{session}"


class Truth:
    """The places most similar to each query, by comparing all."""

    def __init__(self, asked: Vectors) -> None:
        self._asked = asked
        self._best = np.full((len(asked), WANTED), -2.0, np.float32)
        self._ids = np.zeros((len(asked), WANTED), np.int64)

    def add(self, room: int, seen: Vectors) -> None:
        """Take notice of a room's (SESSIONS, PLACES, SIZE)."""
        found = self._asked @ seen.reshape(-1, SIZE).T
        numbers = np.broadcast_to(room * SESSIONS * PLACES + np.arange(found.shape[1]), found.shape)
        best = np.concatenate([self._best, found], axis=1)
        ids = np.concatenate([self._ids, numbers], axis=1)
        order = np.argpartition(-best, WANTED, axis=1)[:, :WANTED]
        self._best = np.take_along_axis(best, order, axis=1)
        self._ids = np.take_along_axis(ids, order, axis=1)

    def recall(self, number: int, found: set[tuple[str, int]]) -> float:
        """Return the share of a query's most similar places that is among those found."""
        room, rest = np.divmod(self._ids[number], SESSIONS * PLACES)
        session, place = np.divmod(rest, PLACES)
        names = [name_of(*each) for each in zip(room, session, strict=True)]
        return len(found & set(zip(names, place.tolist(), strict=True))) / WANTED

    def write(self, path: Path) -> None:
        """Write the places found for the queries."""
        np.save(path, self._ids)

    def read(self, path: Path) -> None:
        """Read what was written for the same queries."""
        self._ids = np.load(path)
