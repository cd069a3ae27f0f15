# SPDX-License-Identifier: Apache-2.0
"""The table that places are kept in: the one door to LanceDB.

It is files in a folder or, with another address, objects in a bucket. There is no server: whoever
writes adds a version of the table, and who is beaten to it tries again.
"""

import math
import os
import random
import re
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import numpy as np

from placerec.checked_recognizer import MAX_LENGTH_ERROR, Embeddings
from placerec.errors import LoopcloseError, RecognizerError, cause_of
from placerec.places.rows import Rows

_NAME, _FINGERPRINT = "places", b"fingerprint"
_COLUMNS = ["session", "keyframe", "time_s", "embedding"]
_SCHEMES = ("s3", "gs", "az")
_PROBES, _REFINED = 550, 4
"""Cells that are looked into, and how many times as many places as wanted are compared exactly.

A quarter of the cells of 10^6 places: in so many dimensions k-means tears apart what is alike.
"""
_SAMPLES, _ROUNDS = 32, 10
"""Of k-means: embeddings for each cell, and how often they are assigned anew."""
_TRIES, _LONGEST_WAIT_S = 20, 2.0
_KEPT = timedelta(hours=1)
"""How long what was replaced stays there for those who read it; no query takes as long."""
_CONFLICT = re.compile("commit conflict|too many concurrent writers", re.IGNORECASE)
_SOURCE = re.compile(r",? /\S+\.rs:\d+:\d+")
"""Where in the library's own source an error was noticed, which tells a user nothing."""
_FROM_AFAR = re.compile(r'<Message>(.*?)</Message>|message: "(.*?)"')
"""What object storage or the system said, among much that tells a user nothing either."""
_MOST_SAID = 200  # characters


class PlaceTable:
    """The table at an address, made by the first who writes.

    Every method raises LoopcloseError where the address cannot be used or the table is damaged.
    """

    def __init__(self, address: str, fingerprint: str) -> None:
        """Connect to an address; `PlaceStore` tells what it can be.

        Raises:
            RecognizerError: what is there is of another fingerprint.
            LoopcloseError: the address cannot be used, the table is damaged, or the library is not
                installed.
        """
        self._address, self._fingerprint = address, fingerprint
        scheme, found, _ = address.partition("://")
        if found and scheme not in _SCHEMES:
            known = ", ".join(f"{each}://" for each in _SCHEMES)
            raise LoopcloseError(f"a store is in a folder or at {known}, not at: {address}")
        lancedb = _library()
        with self._as_one_line():
            self._database = lancedb.connect(address)
        self._table: Any = None
        self.is_there()

    def is_there(self) -> bool:
        """Return whether the table is there by now, and take up what others have written.

        Only here, once for each query: all versions of the last hour are listed for it.
        """
        with self._as_one_line():
            if self._table is not None:
                self._table.checkout_latest()
                return True
            try:
                table = self._database.open_table(_NAME)
            except ValueError as error:
                if "was not found" in str(error):
                    return False
                raise
            made_by = (table.schema.metadata or {}).get(_FINGERPRINT, b"?").decode()
        if made_by != self._fingerprint:
            raise RecognizerError(
                f"the store is of another recognizer, {made_by[:15]}... instead of "
                f"{self._fingerprint[:15]}...: give this one an address of its own: "
                f"{self._address}"
            )
        self._table = table
        return True

    def make(self, size: int) -> None:
        """Make the table, of embeddings of so many values, unless somebody else was faster."""
        import pyarrow as pa

        columns = [pa.string(), pa.int64(), pa.float64(), pa.list_(pa.float32(), size)]
        fields = [pa.field(*each, nullable=False) for each in zip(_COLUMNS, columns, strict=True)]
        schema = pa.schema(fields, metadata={_FINGERPRINT: self._fingerprint.encode()})
        with self._as_one_line():
            try:
                self._database.create_table(_NAME, schema=schema)
            except ValueError as error:
                if "already exists" not in str(error):
                    raise
        if not self.is_there():
            raise LoopcloseError(f"the store is damaged; choose another: {self._address}")

    def check_size(self, size: int) -> None:
        """Refuse embeddings of another number of values.

        Raises:
            RecognizerError: those of the table have another one.
        """
        known = self._table.schema.field("embedding").type.list_size
        if size != known:
            raise RecognizerError(
                f"an embedding has {size} values; those of the store have {known}: {self._address}"
            )

    def count(self, condition: str | None = None) -> int:
        """Return how many places there are, or those that a condition holds for."""
        with self._as_one_line():
            return int(self._table.count_rows(condition))

    def add(self, rows: Rows) -> None:
        """Add places, all or none."""
        import pyarrow as pa

        flat = pa.array(np.ravel(rows.embeddings))
        columns = [
            pa.array([rows.session] * len(rows.keyframes)),
            pa.array(rows.keyframes),
            pa.array(rows.times_s),
            pa.FixedSizeListArray.from_arrays(flat, rows.embeddings.shape[1]),
        ]
        data = pa.Table.from_arrays(columns, schema=self._table.schema)
        for attempt in range(_TRIES):
            try:
                with self._as_one_line():
                    self._table.add(data)
                return
            except ConflictError:  # nothing of it was kept
                time.sleep(random.uniform(0.0, min(_LONGEST_WAIT_S, 0.02 * 2**attempt)))
        raise LoopcloseError(f"too many write to the store at once; try later: {self._address}")

    def nearest(
        self, embedding: Embeddings, count: int, conditions: list[str | None], exact_up_to: int
    ) -> tuple[list[str], list[int], list[float], Embeddings]:
        """Return the columns of the places that are most similar, in no certain order.

        So many of those that each of some conditions holds for, of which no two hold for the same
        place: exactly these where it holds for few, all compared, else those that the cells have.
        """
        import pyarrow as pa

        # A search keeps one core busy, and most have two.
        with self._as_one_line(), ThreadPoolExecutor(len(conditions)) as pool:
            searches = [self._search(embedding, count, each, exact_up_to) for each in conditions]
            found = pa.concat_tables(pool.map(_answer, searches))
            if len(found) < count:  # perhaps these cells have few of such places
                wider = [each.maximum_nprobes(0) for each in searches]
                found = pa.concat_tables(pool.map(_answer, wider))
            flat = np.asarray(found["embedding"].combine_chunks().flatten())
            embeddings = flat.reshape(-1, embedding.size)
            sessions, keyframes, times_s = (found[each].to_pylist() for each in _COLUMNS[:3])
        lengths = np.linalg.norm(embeddings, axis=1)
        if not (np.abs(lengths - 1.0) <= 2 * MAX_LENGTH_ERROR).all():
            raise LoopcloseError(
                f"the store is damaged: embeddings are no longer of unit length: {self._address}"
            )
        return sessions, keyframes, times_s, embeddings

    def _search(
        self, embedding: Embeddings, count: int, condition: str | None, exact_up_to: int
    ) -> Any:
        search = self._table.search(embedding, vector_column_name="embedding")
        search = search.distance_type("cosine").select([*_COLUMNS, "_distance"]).limit(count)
        if condition is not None:
            search = search.where(condition, prefilter=True)
        if self.count(condition) <= exact_up_to:
            return search.bypass_vector_index()
        # Without a bound all cells are looked into, even where the first have enough.
        return search.nprobes(_PROBES).refine_factor(_REFINED)

    def index(self) -> None:
        """Sort the sessions, and divide the embeddings into cells of similar ones.

        The cells are made anew where there are four times as many places as when they were made.

        Raises:
            ConflictError: another process did the same.
        """
        from lancedb.index import BTree, IvfRq

        with self._as_one_line():
            cells = 2 * math.isqrt(int(self._table.count_rows()))
            made = [each.name for each in self._table.list_indices()]
            if "session" not in made:
                self._table.create_index("session", config=BTree(), name="session")
            before = {name: int(name.split("_")[1]) for name in made if name.startswith("cells_")}
            if before and cells < 2 * max(before.values()):
                return
            how = IvfRq("cosine", cells, sample_rate=_SAMPLES, max_iterations=_ROUNDS)
            self._table.create_index("embedding", config=how, name=f"cells_{cells}")
            for name in before:
                self._table.drop_index(name)

    def merge(self) -> None:
        """Merge small pieces, put new places into the indices, and remove what was replaced.

        Raises:
            ConflictError: others wrote without a pause.
        """
        with self._as_one_line():
            self._table.optimize(cleanup_older_than=_KEPT)

    @contextmanager
    def _as_one_line(self) -> Iterator[None]:
        try:
            yield
        except LoopcloseError:
            raise
        except Exception as error:  # mostly ValueError, OSError and RuntimeError
            why = _SOURCE.sub("", cause_of(error))
            if _CONFLICT.search(why):
                raise ConflictError(f"{why}: {self._address}") from error
            if said := _FROM_AFAR.search(why):
                why = said[1] or said[2]
            raise LoopcloseError(
                "cannot use the store: it is damaged, or its address cannot be reached or written: "
                f"{why[:_MOST_SAID]}: {self._address}"
            ) from error


class ConflictError(LoopcloseError):
    """Another process made the next version of the store first."""


def _answer(search: Any) -> Any:
    return search.to_arrow()


def _library() -> Any:
    # It says on stderr what is no news to anybody, such as that a new table is made.
    os.environ.setdefault("LANCEDB_LOG", "error")
    try:
        import lancedb
    except ImportError as error:
        raise LoopcloseError(
            "LanceDB, which keeps places beyond one map, is not installed: pip install "
            "'loopclose[fleet]'"
        ) from error
    return lancedb
