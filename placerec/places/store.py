# SPDX-License-Identifier: Apache-2.0
"""The places of many sessions, which many robots write and ask."""

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.certificate import fingerprint
from placerec.checked_recognizer import COSINES, CheckedRecognizer, Embeddings
from placerec.errors import RecognizerError
from placerec.places.rows import SeenPlace, check_embeddings, checked_rows, conditions, ranked
from placerec.places.table import ConflictError, PlaceTable
from placerec.recognizer import PlaceRecognizer

_log = logging.getLogger(__name__)

EXACT_UP_TO = 10_000
"""So many places are all compared; of more, those that `tidy` has put near the one in question."""
_SPARE = 6
"""Places that are looked for beyond those wanted, because some may be as similar as the last."""
_MARGIN = 1e-6
"""The database rounds similarities otherwise than we do, by less than this."""


class PlaceStore:
    """The places of many sessions, of one recognizer, in a database that many processes share.

    Up to `EXACT_UP_TO` of them, answers are those of a `PlaceIndex` to the last bit.
    """

    def __init__(self, address: str | Path, recognizer: PlaceRecognizer) -> None:
        """Open a store; where there is none yet, the first `add` makes one.

        Args:
            address: a folder, or object storage as in s3://bucket/places, gs://... or az://...,
                with what its makers' own tools take from the environment: keys, region, endpoint.
            recognizer: what makes the embeddings; they are compared by their cosine.

        Raises:
            RecognizerError: the recognizer has a `compare` of its own, or no fingerprint, or the
                store is of another one.
            LoopcloseError: the address cannot be used, the store is damaged, or the database is
                not installed.
        """
        if CheckedRecognizer(recognizer).comparer is not COSINES:
            raise RecognizerError(
                f"recognizer {type(recognizer).__name__!r} compares embeddings by itself; a store "
                "can look for cosines alone: use another recognizer, such as learned"
            )
        self._table = PlaceTable(str(address), fingerprint(recognizer))

    def __len__(self) -> int:
        return self._table.count() if self._table.is_there() else 0

    def add(
        self,
        session: str,
        keyframes: Sequence[int] | NDArray[np.integer],
        times_s: Sequence[float] | NDArray[np.floating],
        embeddings: Embeddings,
    ) -> None:
        """Add places of a session, all or none of them; once this returns they are kept.

        Every call makes a version of the store: give it what some seconds or a session brought.

        Args:
            session: a name that no other session has, such as robot7/2026-11-30.
            keyframes: (N,) numbers in the session's map.
            times_s: (N,) seconds.
            embeddings: (N, D) float32, of unit length.

        Raises:
            RecognizerError: they are not what they must be.
            LoopcloseError: the store cannot be written.
        """
        rows = checked_rows(session, keyframes, times_s, embeddings)
        if not len(embeddings):
            return
        size = embeddings.shape[1]
        if not self._table.is_there():
            self._table.make(size)
        self._table.check_size(size)
        self._table.add(rows)

    def query(
        self,
        embedding: Embeddings,
        count: int,
        sessions: Sequence[str] | None = None,
        recent: tuple[str, float] | None = None,
    ) -> tuple[SeenPlace, ...]:
        """Return the places most similar to an embedding, best first; they are to be verified.

        Args:
            embedding: (D,) float32, of unit length.
            count: how many places are wanted.
            sessions: whose places are looked at; default: all.
            recent: a session, and the second from which on its places are left out: who asks on
                the way does not want the last places of its own.

        Returns:
            At most count places; equal ones by session and keyframe.

        Raises:
            RecognizerError: the embedding is not like those of the store.
            LoopcloseError: the store cannot be read.
        """
        check_embeddings(embedding, 1)
        asked = conditions(sessions, recent)
        if count <= 0 or not self._table.is_there():
            return ()
        self._table.check_size(embedding.size)
        wanted = count + _SPARE
        while True:
            found = self._table.nearest(embedding, wanted, asked, EXACT_UP_TO)
            similarities, seen = ranked(embedding, *found)
            if len(seen) < wanted or similarities[wanted - 1] < similarities[count - 1] - _MARGIN:
                return tuple(seen[:count])
            wanted *= 2  # the database chose among equal ones, by no rule

    def tidy(self) -> None:
        """Put a large store in order, so that asking it stays fast; others may use it meanwhile.

        Merges the pieces that `add` made, and puts new places to those that they are like. One
        process should do so, before there are `EXACT_UP_TO` new ones: until then all of them are
        compared by every query.

        Raises:
            LoopcloseError: the store cannot be written.
        """
        if not self._table.is_there():
            return
        try:
            self._table.merge()
            if self._table.count() > EXACT_UP_TO:
                self._table.index()
        except ConflictError as error:
            _log.warning("the store is not all in order, because others wrote to it: %s", error)
