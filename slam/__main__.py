# SPDX-License-Identifier: Apache-2.0
"""The `run_slam` command, also as `python -m slam`: read a sequence, run, write the folder."""

import gc
import math
import shlex
import sys
from argparse import ArgumentParser
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro
from tqdm import tqdm

from placerec.errors import LoopcloseError, deferred_interrupts
from placerec.files import Progress
from placerec.recognizer import load
from slam.config import Config, load_config
from slam.result import SlamResult
from slam.types import Frame, SlamError

if TYPE_CHECKING:
    from slam.datasets import Sequence, Sessions
    from slam.datasets.pose_files import PoseFile
    from slam.evaluation.drift import DriftReport
    from slam.system import Slam

DEFAULT_RECOGNIZER = "learned"
DEMO = "demo"

_DESCRIPTION = """Track an RGB-D sequence, close its loops, correct the drift and explain it.

  run_slam demo                         render a room and run on it; needs no data
  run_slam fr1_desk                     a sequence of the TUM RGB-D benchmark, fetched if needed
  run_slam path/to/folder               a recording: TUM RGB-D, ICL-NUIM, 7-Scenes, ScanNet,
                                        Replica, Open3D, Redwood, RealSense, Stray Scanner or
                                        Record3D, told by what it holds
  run_slam recording.bag                a ROS 1 bag; so for .mcap, or the folder of a ROS 2 bag
  run_slam fr1_xyz fr1_desk             recordings of one camera, in the order of time: one map
  run_slam fr1_desk --odometry poses.txt
                                        close loops for an odometry that you have: TUM, KITTI,
                                        EuRoC or planar poses, or a bag; told by what it holds
  run_slam fr1_desk --verification.min-inliers 40 --out runs/strict

Writes trajectories, the pose graph, the loop ledger, a point cloud and report.html; open that."""


@dataclass(frozen=True)
class Arguments:
    """What run_slam was asked to do."""

    sequence: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SEQUENCE")]
    """Folder of a recording, ROS bag, short name of a TUM RGB-D sequence, or `demo`."""
    more: Annotated[
        tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[SEQUENCE ...]")
    ] = ()
    """Later recordings of the same camera, which are to make one map with the first."""
    odometry: Annotated[Path | None, tyro.conf.arg(metavar="POSES")] = None
    """File of the poses that another odometry has of the camera, or of the body that it is on."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the outputs; default: runs/SEQUENCE, the names of several joined by +."""
    recognizer: Annotated[str, tyro.conf.arg(metavar="NAME")] = DEFAULT_RECOGNIZER
    """Place recognizer: an installed name, package.module:ClassName, or FILE.safetensors."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """TOML file with settings; flags win over it. Every run writes its own settings.toml."""
    settings: Annotated[Config, tyro.conf.arg(name="")] = field(default_factory=Config)

    @property
    def sequences(self) -> tuple[str, ...]:
        """All recordings, as they were named."""
        return self.sequence, *self.more

    @property
    def title(self) -> str:
        """The names of the recordings' folders, joined by +."""
        return "+".join(Path(each).resolve().name for each in self.sequences)

    @property
    def command(self) -> list[str]:
        """What was typed, but for the settings and the folder."""
        odometry = [] if self.odometry is None else ["--odometry", str(self.odometry)]
        return ["run_slam", *self.sequences, "--recognizer", self.recognizer, *odometry]


def parse(arguments: list[str]) -> Arguments:
    """Return the parsed command line; exits with code 2 and a message where it is wrong.

    Raises:
        SlamError: the settings file cannot be used.
    """
    # --config is found before the rest is parsed: it holds the defaults of the other flags.
    finder = ArgumentParser(add_help=False, allow_abbrev=False)
    finder.add_argument("--config", type=Path, nargs="?")  # tyro tells what it lacks
    path: Path | None = finder.parse_known_args(arguments)[0].config
    defaults = Config() if path is None else load_config(path)
    return tyro.cli(
        tyro.conf.configure(tyro.conf.FlagConversionOff)(Arguments),
        prog="run_slam",
        description=_DESCRIPTION,
        args=arguments,
        default=Arguments(sequence=tyro.MISSING, settings=defaults),
    )


def main(arguments: list[str] | None = None) -> int:
    """Run `run_slam` and return its exit code: 0 good, 2 something the user can mend."""
    # A recognizer that is being written is found in the current folder, as by `python -m`.
    sys.path.append(str(Path.cwd()))
    try:
        _run(parse(sys.argv[1:] if arguments is None else arguments))
    except LoopcloseError as error:
        problem = str(error)
    except KeyboardInterrupt:
        problem = "interrupted before the outputs were complete"
    else:
        return 0
    print(f"run_slam: {problem}", file=sys.stderr)
    return 2


def _run(arguments: Arguments) -> None:
    # The heavy libraries are loaded here, so that --help and typing errors answer at once.
    from slam.datasets import Sessions
    from slam.output.run_folder import make_run_folder, write_run
    from slam.output.summary import summary_table
    from slam.system import Slam

    recognizer = load(arguments.recognizer)
    folder = arguments.out or Path("runs") / arguments.title
    sessions = Sessions([_open(each, arguments, folder) for each in arguments.sequences])
    poses, settings = _read_odometry(arguments, sessions)
    make_run_folder(folder)
    # Looking through all that libraries loaded, for garbage, would hold up tracking for 80 ms.
    gc.collect()
    gc.freeze()
    slam = Slam(sessions.camera, recognizer, settings)
    stopped = _process(slam, sessions, _Feed(slam, poses))
    if stopped and not slam.has_keyframes:
        raise stopped
    # What was done is worth the seconds that writing it takes, but to one who asks again.
    is_interrupted = isinstance(stopped, KeyboardInterrupt)
    reason = "interrupted" if is_interrupted else str(stopped)
    with nullcontext() if is_interrupted else deferred_interrupts():
        result = slam.finish()
        drift, doubts = _judge(result, sessions, arguments)
        if stopped:
            doubts = (f"the run stopped early: {reason}", *doubts)
        result = replace(result, warnings=(*doubts, *sessions.warnings, *result.warnings))
        write_run(
            folder,
            result,
            drift,
            sessions.ground_truth,
            settings,
            arguments.title,
            shlex.join(arguments.command),
            poses,
        )
    print(summary_table(result, drift, folder))
    if result.given and not result.given.fits:
        raise SlamError(f"{result.given.warnings[0]}; what the images alone tell is in {folder}")
    if stopped:
        raise SlamError(f"{reason}; what was done until then is in {folder}")


def _open(name: str, arguments: Arguments, folder: Path) -> "Sequence":
    from slam.datasets import open_sequence, resolve

    if name != DEMO:
        with _progress_bar("fetching", unit="B", unit_scale=True) as progress:
            path = resolve(name, progress)
    elif not (path := folder / "sequence").exists():
        from slam.demo.recording import render_sequence

        with _progress_bar("rendering", unit=" frames") as progress:
            render_sequence(path, progress=progress)
    print(f"reading {path}", file=sys.stderr)
    sequence = open_sequence(path, arguments.settings.input)
    for warning in sequence.warnings:  # now, for they may tell why the run fails
        print(f"warning: {warning}", file=sys.stderr)
    return sequence


def _read_odometry(arguments: Arguments, sessions: "Sessions") -> tuple["PoseFile | None", Config]:
    """Read the poses to be corrected, and where on their body the camera is if they tell."""
    from slam.datasets.pose_files import read_odometry

    settings = arguments.settings
    if arguments.odometry is None:
        return None, settings
    poses = read_odometry(arguments.odometry, sessions.timestamps_s, settings.input)
    for warning in poses.warnings:
        print(f"warning: {warning}", file=sys.stderr)
    if poses.T_base_cam is not None and settings.odometry.T_base_cam is None:
        odometry = settings.odometry.model_copy(update={"T_base_cam": poses.T_base_cam})
        settings = settings.model_copy(update={"odometry": odometry})
    return poses, settings


def _process(slam: "Slam", sessions: "Sessions", feed: "_Feed") -> BaseException | None:
    """Feed all frames; return what stopped it early, so that the frames until then are kept."""
    with deferred_interrupts() as interrupted:  # half a keyframe could not be finished
        try:
            for recording in sessions.recordings:
                slam.start_session()
                for frame in _timed(slam, recording):
                    feed.until(frame.timestamp_s)
                    slam.process(frame)
                    if interrupted.is_set():
                        return KeyboardInterrupt()
            feed.until(math.inf)
            slam.settle()  # if the recognizer failed on one of the last keyframes, say so
        except LoopcloseError as stopped:
            return stopped
    return None


class _Feed:
    """Hands over the poses of a file as they would come with the images."""

    def __init__(self, slam: "Slam", poses: "PoseFile | None") -> None:
        self._slam = slam
        self._next = 0
        self._T = poses.trajectory.T_world_cam if poses else ()
        self._stamps_s = poses.trajectory.timestamps_s.tolist() if poses else []

    def until(self, timestamp_s: float) -> None:
        """Hand over all poses until a time of the images', and one more, to be between two."""
        limit_s = timestamp_s + self._slam.time_offset_s
        while self._next < len(self._stamps_s):
            time_s = self._stamps_s[self._next]
            self._slam.add_pose(time_s, self._T[self._next])
            self._next += 1
            if time_s > limit_s:
                return


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
    from slam.evaluation.drift import compare_drift

    truth = sessions.ground_truth
    if truth is None:
        return None, ("there is no ground truth, so no ATE can be given",)
    try:
        drift = compare_drift(result, truth, arguments.settings.evaluation)
    except SlamError as error:
        return None, (f"no ATE can be given: {error}",)
    return drift, drift.doubts


@contextmanager
def _progress_bar(title: str, **options: object) -> Iterator[Progress]:
    # The delay hides the bar where no progress is ever made.
    with tqdm(desc=title, delay=1e-9, dynamic_ncols=True, **options) as bar:

        def show(done: int, total: int | None) -> None:
            bar.total = total
            bar.update(done - bar.n)

        yield show


if __name__ == "__main__":
    sys.exit(main())
