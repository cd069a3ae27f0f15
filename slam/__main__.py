# SPDX-License-Identifier: Apache-2.0
"""The `run_slam` command, also as `python -m slam`: read a sequence, run, write the folder."""

import gc
import logging
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from placerec.commands import usage
from placerec.commands.console import answer, note, say
from placerec.errors import LoopcloseError, cause_of, deferred_interrupts
from placerec.recognizer import load
from slam.commands import COMMANDS
from slam.commands.opening import DEFAULT_RECOGNIZER, given_poses, opened, settings_file_typed
from slam.config import SECTIONS, Config, load_config
from slam.types import SlamError

if TYPE_CHECKING:
    from slam.output.ending import Ended

_COMPILING = "compiling the inner loops for this machine, which takes some seconds, once"
_log = logging.getLogger("slam")

_DESCRIPTION = """Track an RGB-D sequence, close its loops, correct the drift and explain it.

  run_slam demo                    render a room and run on it; needs no data
  run_slam fr1_desk                of the TUM RGB-D benchmark; fetched if needed
  run_slam path/to/recording       a folder in a format of --help-all, or a bag
  run_slam fr1_xyz fr1_desk        of one camera, in the order of time: one map
  run_slam fr1_desk --odometry poses.txt       loops for poses that you have
  run_slam batch|compare|merge|more-loops|reembed|replay|stress --help

Writes trajectories, the loop ledger, a point cloud, report.html; open that."""
_DETAILS = """

A recording is a folder, told by what it holds: TUM RGB-D, ICL-NUIM, 7-Scenes, ScanNet, Replica,
Open3D, Redwood, RealSense, Stray Scanner or Record3D; or a ROS 1 bag, an .mcap file, or the folder
of a ROS 2 bag. POSES are in TUM, KITTI, EuRoC or planar format, or a bag; told by what it holds.

A setting is a flag, or a line of FILE.toml:

  run_slam fr1_desk --verification.min-inliers 40 --out runs/strict

Completion, for this shell, or for good in its start-up file:

  eval "$(run_slam --completion bash)"
"""


@dataclass(frozen=True)
class Arguments:
    """What run_slam was asked to do."""

    sequence: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SEQUENCE")]
    """Folder of a recording, ROS bag, TUM RGB-D name, or `demo`."""
    more: Annotated[
        tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="[SEQUENCE ...]")
    ] = ()
    """Later recordings of the same camera; all are to make one map."""
    odometry: Annotated[Path | None, tyro.conf.arg(metavar="POSES")] = None
    """Another odometry's poses, of the camera or its body."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the outputs, runs/SEQUENCE unless told; the names of several are joined by +."""
    recognizer: Annotated[str, tyro.conf.arg(metavar="NAME")] = DEFAULT_RECOGNIZER
    """Installed name, module:Class, or file. A file is FILE.safetensors or FILE.onnx."""
    map: Annotated[Literal["points", "mesh", "none"] | None, tyro.conf.arg(metavar="KIND")] = None
    """Map to write, points, mesh (points, too) or none; default: as the settings say, points."""
    save: Annotated[Path | None, tyro.conf.arg(metavar="MAP")] = None
    """Folder to save the map in, for later runs."""
    load: Annotated[Path | None, tyro.conf.arg(metavar="MAP")] = None
    """Map of earlier runs to go on from."""
    localise_only: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Place the camera in the map of --load. That stays as it is."""
    finish: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """SEQUENCE is the folder of a killed run: finish it."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """TOML file with settings; flags win over it. Every run writes its own settings.toml."""
    live: Annotated[bool, tyro.conf.FlagCreatePairsOff] = False
    """Show the run in a Rerun viewer. As it goes on; this needs the extra `live`."""
    rrd: Annotated[Path | None, tyro.conf.arg(metavar="FILE.rrd")] = None
    """Keep what --live shows. It is FILE.unfinished.rrd until the end, and for good if killed."""
    settings: Annotated[Config, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff] = field(
        default_factory=Config
    )

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
        earlier = [] if self.load is None else ["--load", str(self.load)]
        fixed = ["--localise-only"] if self.localise_only else []
        named = ["--recognizer", self.recognizer]
        return ["run_slam", *self.sequences, *named, *odometry, *earlier, *fixed]


def parse(arguments: list[str]) -> Arguments:
    """Return the parsed command line; exits with code 0 after --help and the like.

    Raises:
        LoopcloseError: something is wrong with it, or the settings file cannot be used.
    """
    default = Arguments(sequence=tyro.MISSING, settings=settings_file_typed(arguments))
    description = _DESCRIPTION + _DETAILS if usage.HELP_ALL in arguments else _DESCRIPTION
    told = usage.parsed(Arguments, "run_slam", description, arguments, default, SECTIONS)
    return _with_map(told)


def _with_map(told: Arguments) -> Arguments:
    """Return the arguments with --map put among the settings."""
    if told.map is None:
        return told
    chosen = {"write": told.map != "none", "mesh": told.map == "mesh"}
    settings = told.settings
    of_map = settings.map.model_copy(update=chosen)
    return replace(told, settings=settings.model_copy(update={"map": of_map}))


def main(arguments: list[str] | None = None) -> int:
    """Run `run_slam` and return its exit code: 0 good, 2 something the user can mend."""
    # A recognizer that is being written is found in the current folder, as by `python -m`.
    sys.path.append(str(Path.cwd()))
    typed = sys.argv[1:] if arguments is None else arguments
    if typed[:1] and typed[0] in COMMANDS:  # a folder of that name is ./compare
        command = import_module(f"slam.commands.{typed[0].replace('-', '_')}")
        prog = f"run_slam {typed[0]}"
        return answer(prog, typed[1:], command.main, interrupted="interrupted before it was done")
    return answer("run_slam", typed, _work, interrupted="interrupted before anything was tracked")


def _work(typed: list[str]) -> int:
    told = parse(typed)
    # The heavy libraries are loaded from here on, so that --help and typing errors answer at once.
    from placerec.compiled import telling_of_compiling

    gc.disable()  # what libraries load is no garbage, and would be looked through again and again
    try:
        with telling_of_compiling(lambda: note(_COMPILING)):
            (_finish if told.finish else _run)(told)
    finally:
        gc.enable()
    return 0


def _all_is_loaded() -> None:
    """Look for garbage from now on, but never in what there is, which would hold up a frame."""
    gc.freeze()
    gc.enable()


def _run(arguments: Arguments) -> None:
    from slam.commands.frames import process
    from slam.datasets import Sessions
    from slam.external_odometry.pose_feed import PoseFeed
    from slam.geometry.features import search_images_on_one_thread
    from slam.geometry.freed_memory import share_between_threads
    from slam.output.claimed_folder import OUTPUTS, ClaimedFolder
    from slam.output.ending import Run, conclude, reason_of
    from slam.output.journal import Header, JournalWriter
    from slam.output.live.view import LiveView, check_live
    from slam.output.map_folder.folder import check_place, load_map
    from slam.output.run_folder import begin_outputs
    from slam.system import Slam

    _refuse_together(arguments)
    is_shown = arguments.live or arguments.rrd is not None
    if is_shown:
        check_live(arguments.rrd)
    share_between_threads()
    search_images_on_one_thread()
    folder = arguments.out or Path("runs") / arguments.title
    with ClaimedFolder(folder) as claimed:
        recognizer = load(arguments.recognizer)
        if arguments.save is not None:
            check_place(arguments.save, recognizer)
        sessions = Sessions(
            [opened(each, arguments.settings.input, folder) for each in arguments.sequences]
        )
        poses, settings = given_poses(arguments.odometry, sessions, arguments.settings)
        earlier = load_map(arguments.load, recognizer, settings) if arguments.load else None
        claimed.refuse_foreign(OUTPUTS)
        _all_is_loaded()
        slam = Slam(
            sessions.camera,
            recognizer,
            settings,
            claimed.unfinished,
            earlier=earlier,
            is_fixed=arguments.localise_only,
        )
        header = Header(
            arguments.title,
            shlex.join(arguments.command),
            sessions.camera,
            slam.min_similarity,
            None if arguments.odometry is None else str(arguments.odometry.resolve()),
            sessions.warnings,
            slam.certificate,
            None if arguments.load is None else str(arguments.load),
        )
        truth = sessions.ground_truth
        run = Run(claimed, header, settings, truth, poses, lambda: sessions.warnings)
        run = replace(run, keeps=earlier is None, save=arguments.save)
        feed = PoseFeed(slam, poses.trajectory if poses else None)
        view = LiveView(slam, sessions.camera, arguments.live, arguments.rrd) if is_shown else None
        # A view that cannot be kept is told before what a killed run left here goes.
        with view or nullcontext(), _kept(claimed.path), deferred_interrupts() as interrupted:
            begin_outputs(claimed, settings, header.command, run.truth)
            journal = JournalWriter(claimed.unfinished, header, slam)
            listeners = (journal, view) if view else (journal,)
            with journal:
                stopped = process(slam, sessions.recordings, feed, listeners, interrupted)
            if not slam.has_keyframes:
                claimed.discard()
                if stopped:
                    raise SlamError(reason_of(stopped)) from stopped
            ended = conclude(run, slam, stopped, journal.failure)
            if view:  # all is written by now
                view.finish(ended.result)
            _tell(ended)


def _finish(arguments: Arguments) -> None:
    """Make the outputs of what a run that was killed had done."""
    from slam.evaluation.trajectory import read_tum
    from slam.output.claimed_folder import ClaimedFolder
    from slam.output.ending import Run, conclude
    from slam.output.journal import read_journal
    from slam.output.replay.replayed import poses_again, replayed

    if arguments.live or arguments.rrd or arguments.map == "mesh":
        raise SlamError("--live, --rrd and --map mesh show images, and a killed run has none")
    if arguments.save or arguments.load:
        raise SlamError("--save and --load need the images of a run, and a killed run has none")
    _all_is_loaded()
    with ClaimedFolder(Path(arguments.sequence)) as claimed:
        if claimed.is_complete:
            note(f"the run in this folder is complete: {claimed.path}")
            return
        journal = read_journal(claimed.unfinished)
        header = journal.header
        if header.earlier:
            raise SlamError(f"a killed run on a map cannot be finished; do again: {header.command}")
        settings = load_config(claimed.unfinished / "settings.toml")
        truth_file = claimed.unfinished / "groundtruth.txt"
        truth = read_tum(truth_file) if truth_file.exists() else None
        poses = poses_again(journal, settings)
        run = Run(claimed, header, settings, truth, poses, lambda: header.warnings)
        with _kept(claimed.path), deferred_interrupts():
            slam = replayed(journal, settings, poses)
            if not slam.has_keyframes:
                claimed.discard()
                raise SlamError("the run was killed before it had tracked anything; start it again")
            _tell(conclude(run, slam, is_whole=False))


@contextmanager
def _kept(folder: Path) -> Iterator[None]:
    """Say how what was done can still be had where an end is not reached."""
    finish = f"run_slam {shlex.quote(str(folder))} --finish"
    hint = f"{finish} makes the outputs of what was done until then"
    try:
        yield
    except LoopcloseError:
        raise
    except KeyboardInterrupt:
        raise SlamError(f"interrupted before the outputs were complete; {hint}") from None
    except Exception as error:
        _log.debug("the outputs could not be made", exc_info=True)
        raise SlamError(f"{cause_of(error)}; {hint}") from error


def _tell(ended: "Ended") -> None:
    """Print a run in a few lines; raise what is missing."""
    problems = list(ended.problems)
    try:
        say(ended.table)
    except LoopcloseError as error:  # a full disk, at the end of a pipe
        problems.append(str(error))
    if problems:
        raise SlamError("; ".join(problems))


def _refuse_together(arguments: Arguments) -> None:
    """Refuse what makes no sense together."""
    if arguments.localise_only and (arguments.load is None or arguments.save is not None):
        raise SlamError("--localise-only needs the map to --load, and leaves nothing to --save")
    if arguments.load is not None and arguments.odometry is not None:
        raise SlamError("--load is for the camera alone, without --odometry")


if __name__ == "__main__":
    sys.exit(main())
