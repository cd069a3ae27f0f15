# SPDX-License-Identifier: Apache-2.0
"""Feeds damaged files to the readers, to see whether each answers with a value or with one line.

    python -m benchmarks.fuzz                       every reader for a minute, guided by coverage
    python -m benchmarks.fuzz g2o camera --seconds 600
    python -m benchmarks.fuzz --survey 3000         so many damaged files over all, and what came

From the root of the repository. Runs guided by coverage are those of atheris, which comes with
`pip install -e .[dev]`; it keeps what it learned in fuzz/READER, and a file that a reader failed on
beside it. A reader fails where it raises something else than a LoopcloseError, takes more than 10 s
or more than 1.5 GB.
"""

import argparse
import multiprocessing
import os
import resource
import subprocess
import sys
import tempfile
import time
import traceback
from collections import Counter
from multiprocessing.connection import Connection
from pathlib import Path
from types import FunctionType

from benchmarks.fuzz.mutations import mutated
from benchmarks.fuzz.readers import READERS, Reader

LIMIT_S, LIMIT_MB = 10, 1500
_MEMORY = Path("/dev/shm")
_CORPUS = Path("fuzz")
_DAMAGED_FILES = 20  # of the corpus that a guided run begins with, beside the good one


def main() -> int:
    """Run what was asked for; return 1 where a reader failed."""
    options = _arguments()
    unknown = sorted(set(options.readers) - set(READERS))
    if unknown:
        print(f"there is no reader {', '.join(unknown)}; there are: {', '.join(READERS)}")
        return 2
    chosen = [READERS[name] for name in options.readers or READERS]
    if options.guided:
        return _guide(chosen[0], options.seconds)
    if options.survey:
        return _survey(chosen, options.survey, options.seed)
    command = [
        sys.executable,
        "-m",
        "benchmarks.fuzz",
        "--guided",
        "--seconds",
        str(options.seconds),
    ]
    failed = [each.name for each in chosen if subprocess.run([*command, each.name]).returncode]
    print(f"failed: {', '.join(failed) or 'none'} of {len(chosen)} readers")
    return int(bool(failed))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("readers", nargs="*", metavar="READER")
    parser.add_argument("--seconds", type=int, default=60, help="for each reader")
    parser.add_argument("--survey", type=int, default=0, metavar="COUNT")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--guided", action="store_true", help=argparse.SUPPRESS)
    return parser.parse_args()


def _scratch() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(dir=_MEMORY if _MEMORY.is_dir() else None)


def _guide(reader: Reader, seconds: int) -> int:
    try:
        import atheris
    except ImportError:
        print("guiding by coverage needs atheris: pip install -e .[dev]")
        return 2
    corpus = _CORPUS / reader.name.replace("/", "-")
    corpus.mkdir(parents=True, exist_ok=True)
    with _scratch() as folder:
        good = reader.lay_out(Path(folder))
        (corpus / "good").write_bytes(good)
        for seed in range(_DAMAGED_FILES):
            (corpus / f"damaged-{seed}").write_bytes(mutated(good, reader.is_text, seed))
        reader.try_out(Path(folder), good)  # loads what is loaded at the first call
        for function in _functions():
            atheris.instrument_func(function)
        flags = [f"-max_total_time={seconds}", f"-timeout={LIMIT_S}", f"-rss_limit_mb={LIMIT_MB}"]
        flags += [f"-artifact_prefix={corpus}-failed-", "-print_final_stats=1"]
        print(f"--- {reader.name}", flush=True)
        atheris.Setup(
            [sys.argv[0], str(corpus), *flags],
            lambda content: reader.try_out(Path(folder), content) and None,
        )
        atheris.Fuzz()
    return 0


def _functions() -> list[FunctionType]:
    """Return the functions of both packages that are loaded."""
    names = [name for name in sys.modules if name.split(".")[0] in {"slam", "placerec"}]
    return [
        value
        for name in names
        for value in vars(sys.modules[name]).values()
        if isinstance(value, FunctionType) and value.__module__ == name
    ]


def _survey(readers: list[Reader], count: int, seed: int) -> int:
    """Damage each reader's file so often that it is `count` in all; print what came of it."""
    each = -(-count // len(readers))
    failures = 0
    columns = ("read", "refused", "broken", "failed", "worst s", "MB")
    print(f"{'reader':36}" + "".join(f"{column:>8}" for column in columns))
    for reader in readers:
        found, slowest_s, peak_mb = _in_a_process(reader, range(seed, seed + each))
        failed = each - found["read"] - found["refused"] - found["broken"]
        failed += slowest_s > LIMIT_S or peak_mb > LIMIT_MB
        failures += failed
        counts = (found["read"], found["refused"], found["broken"], failed)
        numbers = "".join(f"{count:8}" for count in counts)
        print(f"{reader.name:36}{numbers}{slowest_s:8.2f}{peak_mb:8.0f}", flush=True)
    print(f"{each * len(readers)} damaged files, {failures} failures")
    return int(failures > 0)


def _in_a_process(reader: Reader, seeds: range) -> tuple[Counter[str], float, float]:
    """Return how often each thing came of a damaged file, the longest time and the peak memory."""
    found: Counter[str] = Counter()
    slowest_s = peak_mb = 0.0
    rest = list(seeds)
    while rest:
        ours, theirs = multiprocessing.Pipe(duplex=False)
        forked = multiprocessing.get_context("fork")
        process = forked.Process(target=_try, args=(reader, rest, theirs))
        process.start()
        theirs.close()
        while rest:
            if not ours.poll(60 + LIMIT_S):
                print(f"    {reader.name}, seed {rest[0]}: takes more than {LIMIT_S} s")
                process.kill()
                slowest_s = float(60 + LIMIT_S)
                break
            try:
                what, took_s, peak_mb_now = ours.recv()
            except EOFError:
                print(f"    {reader.name}, seed {rest[0]}: the process died")
                break
            found[what] += 1
            slowest_s, peak_mb = max(slowest_s, took_s), max(peak_mb, peak_mb_now)
            del rest[0]
        else:
            process.join()
            break
        del rest[0]
    return found, slowest_s, peak_mb


def _try(reader: Reader, seeds: list[int], pipe: Connection) -> None:
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # decoders in C say what they think of it
    with _scratch() as folder:
        good = reader.lay_out(Path(folder))
        for seed in seeds:
            content = mutated(good, reader.is_text, seed)
            start_s = time.monotonic()
            try:
                what = reader.try_out(Path(folder), content).split(":")[0]
            except BaseException:
                what = "failed"
                trace = traceback.format_exc(limit=-4)
                print(f"    {reader.name}, seed {seed}: {trace}", flush=True)
            took_s = time.monotonic() - start_s
            peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
            pipe.send((what, took_s, peak_mb))


if __name__ == "__main__":
    sys.exit(main())
