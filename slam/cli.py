# SPDX-License-Identifier: Apache-2.0
"""The `run_slam` command: read a sequence, run the pipeline, write the run's folder."""

import gc
import shlex
import sys
from collections.abc import Iterator
from contextlib import closing, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from placerec.interruption import deferred_interrupts
from placerec.recognizer import RecognizerError, load
from slam.arguments import Arguments, parse
from slam.types import Frame, SlamError, SlamResult

if TYPE_CHECKING:
    from slam.datasets import Sequence, Sessions
    from slam.drift import DriftReport
    from slam.system import Slam

DEMO = "demo"
BAD_USAGE = 2


def main(arguments: list[str] | None = None) -> int:
    """Run `run_slam` and return its exit code: 0 good, 2 something the user can mend."""
    # A recognizer that is being written is found in the current folder, as by `python -m`.
    sys.path.append(str(Path.cwd()))
    try:
        _run(parse(sys.argv[1:] if arguments is None else arguments))
    except (SlamError, RecognizerError) as error:
        return _fail(str(error))
    except KeyboardInterrupt:
        return _fail("interrupted before the outputs were complete")
    return 0


def _fail(message: str) -> int:
    print(f"run_slam: {message}", file=sys.stderr)
    return BAD_USAGE


def _run(arguments: Arguments) -> None:
    # The heavy libraries are loaded here, so that --help and typing errors answer at once.
    from slam.datasets import Sessions
    from slam.run_folder import make_run_folder, write_run
    from slam.summary_table import summary_table
    from slam.system import Slam

    recognizer = load(arguments.recognizer)
    folder = arguments.out or Path("runs") / arguments.title
    sessions = Sessions([_open(each, arguments, folder) for each in arguments.sequences])
    make_run_folder(folder)
    # Looking through all that libraries loaded, for garbage, would hold up tracking for 80 ms.
    gc.collect()
    gc.freeze()
    slam = Slam(sessions.camera, recognizer, arguments.settings)
    stopped = _process(slam, sessions)
    if stopped and not slam.has_keyframes:
        raise stopped
    # What was done is worth the seconds that writing it takes, but to one who asks again.
    is_second = isinstance(stopped, KeyboardInterrupt)
    with nullcontext() if is_second else deferred_interrupts():
        result = slam.finish()
        drift, doubts = _judge(result, sessions, arguments)
        if stopped:
            doubts = (f"the run stopped early: {_why(stopped)}", *doubts)
        result = replace(result, warnings=(*doubts, *sessions.warnings, *result.warnings))
        write_run(
            folder,
            result,
            drift,
            sessions.ground_truth,
            arguments.settings,
            title=arguments.title,
            command=shlex.join(
                ["run_slam", *arguments.sequences, "--recognizer", arguments.recognizer]
            ),
        )
    print(summary_table(result, drift, folder))
    if stopped:
        raise SlamError(f"{_why(stopped)}; what was done until then is in {folder}")


def _open(name: str, arguments: Arguments, folder: Path) -> "Sequence":
    from slam.datasets import open_sequence, resolve

    if name == DEMO:
        path = folder / "sequence"
        if not path.exists():
            _render_demo(path)
    else:
        with closing(_Bar("fetching", unit="B", unit_scale=True)) as bar:
            path = resolve(name, bar)
    print(f"reading {path}", file=sys.stderr)
    sequence = open_sequence(path, arguments.settings.input)
    for warning in sequence.warnings:  # now, for they may tell why the run fails
        print(f"warning: {warning}", file=sys.stderr)
    return sequence


def _render_demo(path: Path) -> None:
    from slam.datasets.synthetic import render_sequence

    with closing(_Bar("rendering", unit=" frames")) as bar:
        render_sequence(path, progress=bar)


def _process(slam: "Slam", sessions: "Sessions") -> BaseException | None:
    """Feed all frames; return what stopped it early, so that the frames until then are kept."""
    with deferred_interrupts() as interrupted:  # half a keyframe could not be finished
        try:
            for recording in sessions.recordings:
                slam.start_session()
                for frame in _timed(slam, recording):
                    slam.process(frame)
                    if interrupted.is_set():
                        return KeyboardInterrupt()
            slam.settle()  # if the recognizer failed on one of the last keyframes, say so
        except (SlamError, RecognizerError) as stopped:
            return stopped
    return None


def _timed(slam: "Slam", sequence: "Sequence") -> Iterator[Frame]:
    frames = iter(sequence)
    with tqdm(total=len(sequence), desc="tracking", unit=" frames", dynamic_ncols=True) as bar:
        while True:
            with slam.clock.stage("read"):
                frame = next(frames, None)
            if frame is None:
                return
            yield frame
            bar.update()


def _judge(
    result: SlamResult, sessions: "Sessions", arguments: Arguments
) -> tuple["DriftReport | None", tuple[str, ...]]:
    """Compare with ground truth where there is enough of it; else say why not."""
    from slam.drift import compare_drift

    truth = sessions.ground_truth
    if truth is None:
        return None, ("there is no ground truth, so no ATE can be given",)
    try:
        drift = compare_drift(
            result.odometry,
            result.trajectory,
            truth,
            result.attempts,
            result.keyframes,
            arguments.settings.evaluation,
            result.session_starts_s,
        )
    except SlamError as error:
        return None, (f"no ATE can be given: {error}",)
    return drift, ()


def _why(stopped: BaseException) -> str:
    return "interrupted" if isinstance(stopped, KeyboardInterrupt) else str(stopped)


class _Bar:
    """A progress bar that appears with the first progress."""

    def __init__(self, title: str, **options: object) -> None:
        self._title = title
        self._options = options
        self._bar: tqdm | None = None

    def __call__(self, done: int, total: int | None) -> None:
        if self._bar is None:
            self._bar = tqdm(desc=self._title, total=total, dynamic_ncols=True, **self._options)
        self._bar.update(done - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()


if __name__ == "__main__":
    sys.exit(main())
