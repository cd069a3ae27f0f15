# SPDX-License-Identifier: Apache-2.0
"""`run_slam replay`: decide about the loops of a run again, without its images."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from placerec.commands import usage
from placerec.commands.console import say
from placerec.errors import LoopcloseError, cause_of
from slam.config import SECTIONS, Config, load_config
from slam.types import SlamError

if TYPE_CHECKING:
    from slam.datasets.pose_files import PoseFile
    from slam.output.claimed_folder import ClaimedFolder
    from slam.output.replay.measurements import Measurements
    from slam.system import Slam

_WITH_FEATURES = ("loop", "verification", "graph", "motion", "evaluation")
_WITHOUT = ("graph", "motion", "evaluation")
_AGAIN = (
    "decided again from what {} measured: the camera is where it was tracked, and there are no"
    " pictures and no point cloud"
)
_WHY = "had too many keyframes, was killed, or its recognizer compares by itself"
_NOT_WHOLE = "the run stopped early: what its recordings show later is not in this"
_DESCRIPTION = """Decide about the loops of a run again, with other settings, without its images.

  run_slam replay runs/fr1_desk                    the same decisions again
  run_slam replay runs/fr1_desk --verification.min-inliers 20
  run_slam replay runs/fr1_desk --graph.inlier-probability 0.99 --out runs/more

The run's own settings hold unless told. Similarity, geometry, pose graph and
the map's adjustment are done anew; what the camera was tracked by is not: what
--input, --features, --odometry, --keyframes and --map set stays. To try those,
run the recording again."""


@dataclass(frozen=True)
class Arguments:
    """What to decide again, and how."""

    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")]
    """Folder of a run."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the outputs, RUN-COMMAND unless told."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """TOML file with settings instead of the run's; flags win over it."""
    settings: Annotated[Config, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff] = field(
        default_factory=Config
    )


@dataclass(frozen=True)
class Again:
    """A command that decides about a run again.

    Attributes:
        name: of the command, and of the folder for its outputs.
        description: for --help.
        slam: makes the run once more, all frames taken, ready to be finished.
        needs_features: whether nothing can be done without those of the keyframes.
    """

    name: str
    description: str
    slam: "Callable[[Measurements, Config, PoseFile | None], Slam]"
    needs_features: bool = False


def main(typed: list[str]) -> int:
    """Decide again and return the exit code 0.

    Raises:
        LoopcloseError: something is wrong with what was typed, or with the run.
    """
    return decide_again(typed, _REPLAY)


def decide_again(typed: list[str], again: Again) -> int:
    """Decide again, in which way ever, and return the exit code 0.

    Raises:
        LoopcloseError: something is wrong with what was typed, or with the run.
    """
    arguments = parse(typed, again)
    from slam.geometry.features import search_images_on_one_thread
    from slam.output.replay.measurements import MEASUREMENTS, read_measurements

    search_images_on_one_thread()
    run = arguments.run
    if not (run / MEASUREMENTS).exists():
        raise SlamError(
            f"there is no {MEASUREMENTS} of a run in this folder, without which nothing can be"
            f" decided again: {run}"
        )
    measured = read_measurements(run / MEASUREMENTS, arguments.settings)
    before = load_config(run / "settings.toml")
    _refuse_what_cannot_be(before, arguments.settings, measured)
    if again.needs_features and not measured.remembered:
        raise SlamError(
            f"the run kept no features, without which no loop can be verified: it {_WHY}: {run}"
        )
    _decide(arguments, measured, again)
    return 0


def _replayed(measured: "Measurements", settings: Config, poses: "PoseFile | None") -> "Slam":
    from slam.output.replay.replayed import replayed

    return replayed(measured.journal, settings, poses, measured.remembered)


_REPLAY = Again("replay", _DESCRIPTION, _replayed)


def parse(typed: list[str], again: Again = _REPLAY) -> Arguments:
    """Return the parsed command line; exits with code 0 after --help and the like.

    Raises:
        LoopcloseError: something is wrong with it, or the settings cannot be read.
    """
    first = _parse(typed, again, Config())  # tells the run, whose settings are what is not typed
    path = first.config or first.run / "settings.toml"
    return _parse(typed, again, load_config(path)) if first.config or path.is_file() else first


def _parse(typed: list[str], again: Again, defaults: Config) -> Arguments:
    default = Arguments(run=tyro.MISSING, settings=defaults)
    prog = f"run_slam {again.name}"
    return usage.parsed(Arguments, prog, again.description, typed, default, SECTIONS)


def _refuse_what_cannot_be(before: Config, now: Config, measured: "Measurements") -> None:
    """Refuse settings that only the images, or what was not kept, could answer for."""
    free = _WITH_FEATURES if measured.remembered else _WITHOUT
    for section, values in now:
        for name, value in values:
            if section in free or value == getattr(getattr(before, section), name):
                continue
            flag = f"--{section}.{name}".replace("_", "-")
            why = "its images are needed for that"
            if section in _WITH_FEATURES:
                why = f"it kept no features: it {_WHY}"
            raise SlamError(f"{flag} cannot be decided again for this run: {why}; run it again")


def _decide(arguments: Arguments, measured: "Measurements", again: Again) -> None:
    import shlex
    from dataclasses import replace

    from slam.output.claimed_folder import OUTPUTS, ClaimedFolder
    from slam.output.ending import Run, conclude
    from slam.output.replay.replayed import poses_again
    from slam.output.run_folder import begin_outputs

    run, journal, settings = arguments.run, measured.journal, arguments.settings
    here = run.resolve()  # `.` has no name
    folder = arguments.out or here.with_name(f"{here.name}-{again.name}")
    if folder.resolve() == here:
        raise SlamError(f"--out is the run that is decided again; choose another folder: {folder}")
    partly = () if journal.is_whole else (_NOT_WHOLE,)
    told = (*journal.header.warnings, *partly, _AGAIN.format(run))
    header = replace(journal.header, command=shlex.join(["run_slam", again.name, str(run)]))
    poses = poses_again(journal, settings)
    with ClaimedFolder(folder) as claimed:
        claimed.refuse_foreign(OUTPUTS)
        begin_outputs(claimed, settings, header.command, measured.truth)
        truth = measured.truth
        asked = Run(claimed, header, settings, truth, poses, lambda: told, keeps=False)
        with _all_or_nothing(claimed, run):
            ended = conclude(asked, again.slam(measured, settings, poses))
        say(ended.table)
        if ended.problems:
            raise LoopcloseError("; ".join(ended.problems))


@contextmanager
def _all_or_nothing(claimed: "ClaimedFolder", run: Path) -> Iterator[None]:
    """Leave nothing unfinished where a replay fails: there is no journal to finish it by."""
    try:
        yield
    except BaseException as error:
        claimed.discard()
        known = isinstance(error, LoopcloseError | MemoryError)
        if known or not isinstance(error, Exception):
            raise
        raise SlamError(  # of numbers that no run measures
            f"what the run measured makes no sense: {cause_of(error)}: {run}"
        ) from error
