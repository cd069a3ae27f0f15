# SPDX-License-Identifier: Apache-2.0
"""How long the place index takes as it grows: prints a Markdown table, a column per size.

    python -m benchmarks.place_recognition.place_index [--places 1000 10000 100000]
        [--values 1000] [--queries 100]

Embeddings are random unit vectors, so that next to nothing can be ruled out early. Half of the
queries are places of the map, seen again with a little noise; half resemble none. Every place is
added and timed one by one. Before the queries are timed, some answers are compared with those of
the plain comparison of all, and the command ends with 1 where they differ in any bit.

On a busy machine look at the work, the processors' time of all threads: a query of a large map is
shared out evenly.

Last comes what the end of a run asks: how alike the keyframes are, as many as its report shows.
"""

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from benchmarks.sequences import machine
from placerec.checked_recognizer import COSINES
from placerec.places.index import PlaceIndex
from slam.result import compared

WANTED = 10  # places for each query, a few more than run_slam asks for
CHECKED = 3  # queries of which every cosine is computed
NOISE = 0.5  # its length, beside places of length 1


def unit(rng: np.random.Generator, values: int) -> NDArray[np.float32]:
    """Return a random direction."""
    vector = rng.standard_normal(values)
    return (vector / np.linalg.norm(vector)).astype(np.float32)


def timed(act: Callable[[], object]) -> tuple[float, float]:
    """Return the seconds that something takes, and the work of all threads meanwhile, seconds."""
    start_s, start_work_s = time.perf_counter(), time.process_time()
    act()
    return time.perf_counter() - start_s, time.process_time() - start_work_s


def filled(places: int, values: int) -> tuple[PlaceIndex, NDArray[np.float64]]:
    """Return an index of so many places, and (places, 2), what `timed` says of adding each."""
    rng, index, add_s = np.random.default_rng(0), PlaceIndex(), np.empty((places, 2))
    for k in range(places):
        add_s[k] = timed(partial(index.add, unit(rng, values)))
    return index, add_s


def asked(places: int, values: int, count: int) -> list[NDArray[np.float32]]:
    """Return so many queries, of which every other is a place of `filled` seen again."""
    rng, again = np.random.default_rng(0), np.random.default_rng(1)
    seen = [unit(rng, values) for _ in range(min(places, count))]
    queries = []
    for number in range(count):
        query = unit(again, values)
        if number % 2 == 0:
            query = seen[number % len(seen)] + np.float32(NOISE) * query
        queries.append(query / np.linalg.norm(query))
    return queries


def is_exact(index: PlaceIndex, places: int, queries: list[NDArray[np.float32]]) -> bool:
    """Return whether the answers are, to the last bit, those of comparing with every place."""
    rng = np.random.default_rng(0)
    every = np.empty((len(queries), places), np.float32)
    for k in range(places):
        every[:, k] = COSINES.compare(np.stack(queries), unit(rng, queries[0].size)[None])[:, 0]
    for query, similarities in zip(queries, every, strict=True):
        best = np.argsort(-similarities, kind="stable")[:WANTED]
        ids, found = index.query(query, WANTED)
        if ids.tolist() != best.tolist() or found.tobytes() != similarities[best].tobytes():
            return False
    return True


def measure(places: int, values: int, count: int) -> list[str] | None:
    """Return the cells of a column, None where an answer is not that of the plain comparison."""
    index, add_s = filled(places, values)
    queries = asked(places, values, count)
    if not is_exact(index, places, queries[:CHECKED]):
        return None
    query_s, query_work_s = np.transpose(
        [timed(partial(index.query, query, WANTED)) for query in queries]
    )
    add_s, add_work_s = add_s.T
    end_s, _ = timed(lambda: index.similarities(compared(places).step))
    figures = (
        np.median(query_s),
        np.quantile(query_s, 0.99),
        np.median(query_work_s),
        np.median(add_s),
        add_s.max(),
        add_work_s.max(),
        end_s,
    )
    return [f"{places:,}", *(f"{1e3 * figure:.2f}" for figure in figures)]


TITLES = (
    "places",
    "query, median, ms",
    "query, 99 of 100, ms",
    "query, work, median, ms",
    "add, median, ms",
    "add, longest, ms",
    "add, most work, ms",
    "end of the run, ms",
)


def main(arguments: list[str] | None = None) -> int:
    """Measure and print; return 1 where an answer is not that of the plain comparison."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--places", type=int, nargs="+", default=(1_000, 10_000, 100_000), metavar="K",
        help="sizes of the index; 100,000 places of 1,000 values take 0.5 GB",
    )  # fmt: skip
    parser.add_argument("--values", type=int, default=1000, metavar="D", help="of an embedding")
    parser.add_argument("--queries", type=int, default=100, metavar="N", help="timed of each size")
    parsed = parser.parse_args(arguments)
    if min(*parsed.places, parsed.values, parsed.queries) < 1:
        parser.error("--places, --values and --queries: at least 1")
    facts = machine()
    columns = [measure(places, parsed.values, parsed.queries) for places in parsed.places]
    if None in columns:
        print("an answer is not that of the plain comparison", file=sys.stderr)
        return 1
    rows = list(zip(TITLES, *(column for column in columns if column), strict=True))
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    lines.insert(1, "|---" * (len(columns) + 1) + "|")
    print("\n".join(lines))
    print(f"\n{parsed.values} values, {parsed.queries} queries, {WANTED} wanted; {facts}.")
    return 0


if __name__ == "__main__":
    sys.exit(main())
