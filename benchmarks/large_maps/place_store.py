# SPDX-License-Identifier: Apache-2.0
"""What a store of the places of many sessions takes as it grows, a column per size.

    python -m benchmarks.large_maps.place_store [--places 10000 100000] [--queries 500]
        [--alike] [--out runs/place_store] [--keep]

The embeddings are made up like those of the default recognizer, or with `--alike` like those of one
to which far more looks the same (`made_up_places.py`). Queries are another session of some rooms,
and what they should find is computed from the embeddings themselves.

Each size has a process of its own, that its memory can be told, and about 4.2 kB on the disk for
each place, twice as much while `tidy` works. With `--keep` the stores are left there, and those
that an earlier run left are asked again instead of being made anew, by as many queries.

In the end eight processes add places at once, another asks meanwhile, and one that adds is killed;
the exit code is 1 where a place is lost. Linux only.
"""

import argparse
import multiprocessing
import shutil
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from benchmarks.large_maps.made_up_places import (
    AS_LEARNED,
    MORE_ALIKE,
    PLACES,
    SESSIONS,
    WANTED,
    Likeness,
    Truth,
    Vectors,
    name_of,
    queries,
    rooms_of,
    views,
)
from benchmarks.sequences import machine
from placerec import PlaceStore
from placerec.places.store import EXACT_UP_TO

TIDIED = 250  # rooms, after which the store is put in order
WRITERS, BATCHES, BATCH = 8, 20, 50


class NoRecognizer:
    """Stands for what made the embeddings."""

    min_similarity = 0.5
    fingerprint = "made up"

    def embed(self, image: NDArray[np.uint8]) -> Vectors:
        """Not asked."""
        raise NotImplementedError


def asked_of(store: PlaceStore, asked: Vectors, truth: Truth) -> tuple[NDArray[np.float64], float]:
    """Return the seconds of each query, and the mean recall."""
    took_s, recalls = np.empty(len(asked)), np.empty(len(asked))
    for k, embedding in enumerate(asked):
        start_s = time.perf_counter()
        # As a robot asks that is underway; it has no place here that would be too recent.
        found = store.query(embedding, WANTED, recent=(name_of(0, 0), float(PLACES)))
        took_s[k] = time.perf_counter() - start_s
        recalls[k] = truth.recall(k, {(each.session, each.keyframe) for each in found})
    return took_s, float(recalls.mean())


def most_mb() -> float:
    """Return the most memory that this process had, MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))


def size_b(folder: Path) -> int:
    """Return the bytes of all files in a folder."""
    return sum(each.stat().st_size for each in folder.rglob("*") if each.is_file())


def filled(store: PlaceStore, rooms: int, likeness: Likeness, truth: Truth) -> float:
    """Add the places of so many rooms, and return the seconds that the store took."""
    add_s = 0.0
    for room, seen in rooms_of(rooms, likeness):
        truth.add(room, seen)
        start_s = time.perf_counter()
        for session in range(SESSIONS):
            times_s = 1e5 * session + np.arange(PLACES)
            store.add(name_of(room, session), np.arange(PLACES), times_s, seen[session])
        add_s += time.perf_counter() - start_s
        if (room + 1) % TIDIED == 0 and room + 1 < rooms:
            store.tidy()
    return add_s


def making(
    folder: Path, rooms: int, likeness: Likeness, asked: Vectors, truth: Truth
) -> dict[str, str]:
    """Make a store, and return what it took."""
    store = PlaceStore(folder, NoRecognizer())
    add_s, before_mb = filled(store, rooms, likeness, truth), most_mb()
    few = max(3, min(len(asked), 1000 // rooms))
    whole_s, whole_recall = asked_of(store, asked[:few], truth)
    start_s, start_work_s = time.perf_counter(), time.process_time()
    store.tidy()
    tidy_s, tidy_work_s = time.perf_counter() - start_s, time.process_time() - start_work_s
    return {
        "adding 100, ms": f"{1e3 * add_s / (rooms * SESSIONS):.1f}",
        "before tidy: query, median, ms": f"{1e3 * np.median(whole_s):.0f}",
        "before tidy: recall@10": f"{whole_recall:.4f}",
        "tidy, s": f"{tidy_s:.0f}",
        "tidy, work, s": f"{tidy_work_s:.0f}",
        "memory before tidy, MB": f"{before_mb:.0f}",
        "memory with tidy, MB": f"{most_mb():.0f}",
    }


def asking(folder: Path, asked: Vectors, truth: Truth) -> dict[str, str]:
    """Ask a store, and return what it took."""
    start_s = time.perf_counter()
    store = PlaceStore(folder, NoRecognizer())
    store.query(asked[0], WANTED)
    first_s = time.perf_counter() - start_s
    asked_of(store, asked[: len(asked) // 5], truth)
    work_s = time.process_time()
    query_s, recall = asked_of(store, asked, truth)
    work_s = (time.process_time() - work_s) / len(asked)
    return {
        "opening and the first query, ms": f"{1e3 * first_s:.0f}",
        "query, median, ms": f"{1e3 * np.median(query_s):.1f}",
        "query, 99 of 100, ms": f"{1e3 * np.quantile(query_s, 0.99):.1f}",
        "query, work, mean, ms": f"{1e3 * work_s:.1f}",
        "recall@10": f"{recall:.4f}",
        "memory with asking, MB": f"{most_mb():.0f}",
    }


def measure(places: int, count: int, likeness: Likeness, folder: Path) -> dict[str, str]:
    """Return a column of the table; of a store that is not there yet with what making it took."""
    rooms, kept = places // (SESSIONS * PLACES), folder.with_suffix(f".{count}.npy")
    asked = queries(rooms, count, likeness)
    truth, made = Truth(asked), {}
    if kept.is_file() and folder.is_dir():
        truth.read(kept)
    else:
        shutil.rmtree(folder, ignore_errors=True)
        made = making(folder, rooms, likeness, asked, truth)
        truth.write(kept)
    indices = size_b(next(folder.glob("*.lance")) / "_indices") if places > EXACT_UP_TO else 0
    return {
        "places": f"{rooms * SESSIONS * PLACES:,}",
        **asking(folder, asked, truth),
        "bytes for each place": f"{size_b(folder) / places:.0f}",
        "of these, for the search": f"{indices / places:.0f}",
        **made,
    }


def write(folder: Path, writer: int, batches: int) -> int:
    """Add batches of places to a store, and return how many places."""
    store = PlaceStore(folder, NoRecognizer())
    seen = views(10**6 + writer, range(1))[0]
    for batch in range(batches):
        numbers = np.arange(batch * BATCH, (batch + 1) * BATCH)
        store.add(f"writer{writer}", numbers, numbers / 2.0, seen[numbers % PLACES])
    return batches * BATCH


def written_at_once(folder: Path) -> tuple[str, bool]:
    """Let some write at once, kill one that would never end, and say whether nothing is lost."""
    context = multiprocessing.get_context("spawn")
    killed = context.Process(target=write, args=(folder, WRITERS, 50 * BATCHES))
    killed.start()
    start_s, store, slowest_s = time.perf_counter(), PlaceStore(folder, NoRecognizer()), 0.0
    query = views(10**6, range(1, 2))[0, 0]
    with ProcessPoolExecutor(WRITERS, mp_context=context) as pool:
        tasks = [pool.submit(write, folder, writer, BATCHES) for writer in range(WRITERS)]
        while not all(task.done() for task in tasks):
            asked_s = time.perf_counter()
            store.query(query, WANTED)
            slowest_s = max(slowest_s, time.perf_counter() - asked_s)
            if any(task.done() for task in tasks):
                killed.kill()
        written = [task.result() for task in tasks]
    took_s = time.perf_counter() - start_s
    killed.kill()
    killed.join()
    again = PlaceStore(folder, NoRecognizer())
    seen = [
        {each.keyframe for each in again.query(query, 10**6, sessions=[f"writer{writer}"])}
        for writer in range(WRITERS + 1)
    ]
    is_whole = all(
        numbers == set(range(count)) for numbers, count in zip(seen[:-1], written, strict=True)
    )
    is_whole &= len(seen[-1]) % BATCH == 0 and len(again) == sum(map(len, seen))
    text = (
        f"{WRITERS} writers at once added {sum(written):,} places, {BATCH} at a time, in "
        f"{took_s:.0f} s, and a ninth {len(seen[-1]):,} until it was killed; "
        f"{len(again):,} are there. The slowest query meanwhile took {1e3 * slowest_s:.0f} ms."
    )
    return text, is_whole


def main(arguments: list[str] | None = None) -> int:
    """Measure and print; return 1 where a place was lost."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--places", type=int, nargs="+", default=(10_000, 100_000), metavar="K")
    parser.add_argument("--queries", type=int, default=500, metavar="N", help="timed of each size")
    parser.add_argument("--alike", action="store_true", help="embeddings that are more alike")
    parser.add_argument("--out", type=Path, default=Path("runs/place_store"), metavar="FOLDER")
    parser.add_argument(
        "--keep", action="store_true", help="leave the stores there, and ask those left before"
    )
    parsed = parser.parse_args(arguments)
    if min(parsed.places) < SESSIONS * PLACES or parsed.queries < 10:
        parser.error(f"--places: at least {SESSIONS * PLACES}; --queries: at least 10")
    parsed.out.mkdir(parents=True, exist_ok=True)
    likeness, name = (MORE_ALIKE, "alike") if parsed.alike else (AS_LEARNED, "store")
    facts, columns = machine(), []
    for places in parsed.places:
        folder = parsed.out / f"{name}_{places}"
        if not parsed.keep:
            shutil.rmtree(folder, ignore_errors=True)
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
            asked = process.submit(measure, places, parsed.queries, likeness, folder)
            columns.append(asked.result())
        if not parsed.keep:
            shutil.rmtree(folder)
            folder.with_suffix(f".{parsed.queries}.npy").unlink()
    titles = list(dict.fromkeys(title for each in columns for title in each))
    lines = [
        "| " + " | ".join([title, *(each.get(title, "") for each in columns)]) + " |"
        for title in titles
    ]
    lines.insert(1, "|---" * (len(columns) + 1) + "|")
    shutil.rmtree(parsed.out / "writers", ignore_errors=True)
    said, is_whole = written_at_once(parsed.out / "writers")
    text = "\n".join(lines) + f"\n\n{parsed.queries} queries, {WANTED} wanted; {facts}.\n\n{said}\n"
    print(text, end="")
    (parsed.out / "place_store.md").write_text(text)
    return 0 if is_whole else 1


if __name__ == "__main__":
    sys.exit(main())
