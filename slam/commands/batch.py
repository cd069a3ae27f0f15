# SPDX-License-Identifier: Apache-2.0
"""`run_slam batch`: a run on each of many recordings, here or on a Ray cluster."""

import io
import os
import time
from collections.abc import Container, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from placerec.commands import usage
from placerec.commands.console import note, say
from placerec.commands.fleet import (
    CORES,
    LOCAL,
    MEMORY_MB,
    Fleet,
    Interrupted,
    from_anywhere,
    run_named,
)
from placerec.errors import cause_of
from placerec.files import is_file, read_text, write_atomically
from placerec.recognizer import load
from slam.commands.named_recordings import NamedRecording, named_recordings
from slam.commands.opening import DEFAULT_RECOGNIZER, settings_file_typed
from slam.config import SECTIONS, Config, to_toml
from slam.types import SlamError

if TYPE_CHECKING:
    from slam.output.comparison.batch import Outcome

PROG = "run_slam batch"
SETTINGS = "batch.toml"
"""In the folder of all runs: the settings that each of them has."""

_SAID = "run_slam: "  # before what `run_slam` says last
_INTERRUPTED = "interrupted"  # how that begins where nobody wanted it to go on
_NOT_HERE = (
    "it was run, but its folder does not show that here; all nodes, and this machine, have to see"
    " --out at the same path"
)
_PATIENCE_S = 30  # with a run that goes on on a node that is taken for dead
_DESCRIPTION = """Run on many recordings, each by itself, and put all into one table.

  run_slam batch recordings/*                  each gets its folder runs/NAME
  run_slam batch runs.txt --out RUNS           a list, one recording per line
  run_slam batch runs.txt --out RUNS --address ray://head:10001

The same command goes on with what is not done. Needs the extra `fleet`."""


@dataclass(frozen=True)
class Arguments:
    """What run_slam batch was asked to do."""

    recordings: Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="RECORDING ...", help_behavior_hint="(at least one)"),
    ]
    """As run_slam takes them, or LIST.txt of them. A line of it may be `NAME = RECORDING`."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("runs")
    """Folder for the folders of all runs."""
    save: Annotated[Path | None, tyro.conf.arg(metavar="MAPS")] = None
    """Folder for the folders of all maps, for run_slam merge."""
    address: Annotated[str, tyro.conf.arg(metavar="ADDRESS")] = LOCAL
    """Ray cluster to run on; local: the cores of this machine."""
    cores: Annotated[int, tyro.conf.arg(metavar="NUMBER")] = CORES
    """Of each run."""
    memory_mb: Annotated[int, tyro.conf.arg(metavar="MB")] = MEMORY_MB
    """Of each run; see docs/costs.md."""
    recognizer: Annotated[str, tyro.conf.arg(metavar="NAME")] = DEFAULT_RECOGNIZER
    """As for run_slam."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """TOML file with settings; flags win over it."""
    settings: Annotated[Config, tyro.conf.arg(name=""), tyro.conf.FlagConversionOff] = field(
        default_factory=Config
    )


@dataclass(frozen=True)
class Job:
    """A run that is to be done, in plain words, as it goes to another machine.

    Attributes:
        folder: for its outputs.
        typed: what would be typed after `run_slam`.
        saved: folder for its map; None where that is not to be kept.
    """

    folder: str
    typed: tuple[str, ...]
    saved: str | None = None

    @property
    def summary(self) -> dict[str, object] | None:
        """That of the run if it is done, and its map is there if it is to be kept; else None."""
        from slam.output.comparison.batch import summary_of_done
        from slam.output.map_folder.folder import MANIFEST

        if self.saved is not None and not is_file(Path(self.saved) / MANIFEST):
            return None
        return summary_of_done(Path(self.folder))


def main(typed: list[str]) -> int:
    """Run on what was named and return the exit code 0.

    Raises:
        LoopcloseError: something is wrong with what was typed, or some of the runs failed.
    """
    told = parse(typed)
    fleet = Fleet(told.address, told.cores, told.memory_mb)
    recordings = named_recordings(told.recordings)
    # Loaded from here on, so that --help and typing errors answer at once.
    from slam.output.claimed_folder import ClaimedFolder

    try:
        with ClaimedFolder(told.out):
            failed = _all(told, fleet, recordings)
    except KeyboardInterrupt:
        raise SlamError(
            f"interrupted; the same command goes on from what is in {told.out}"
        ) from None
    if failed:
        raise SlamError(
            f"{len(failed)} of {len(recordings)} recordings failed, which the same command tries"
            f" again: {', '.join(failed)}"
        )
    return 0


def parse(typed: list[str]) -> Arguments:
    """Return the parsed command line; exits with code 0 after --help and the like.

    Raises:
        LoopcloseError: something is wrong with it, or the settings cannot be read.
    """
    default = Arguments(recordings=tyro.MISSING, settings=settings_file_typed(typed))
    return usage.parsed(Arguments, PROG, _DESCRIPTION, typed, default, SECTIONS)


def _all(told: Arguments, fleet: Fleet, recordings: Sequence[NamedRecording]) -> list[str]:
    """Do the runs that are not done, tell of all, and return the names of those that failed."""
    from slam.output.comparison.batch import PAGE, as_files, table
    from slam.output.comparison.tables import as_text

    load(told.recognizer)  # before anything is started with one that there is not
    out = told.out.resolve()
    jobs = {each.name: _job(told, each, out) for each in recordings}
    _refuse_what_was_run_otherwise(told, jobs)
    _write_settings(out, told.settings, jobs)
    todo = [name for name, job in jobs.items() if job.summary is None]
    if len(todo) < len(jobs):
        note(f"{len(jobs) - len(todo)} of {len(jobs)} recordings are done already")
    whys = _run({name: jobs[name] for name in todo}, fleet) if todo else {}
    outcomes = [_outcome(name, job, whys.get(name, "")) for name, job in jobs.items()]
    for name, content in as_files(outcomes).items():
        write_atomically(out / name, content)
    say(as_text(table(outcomes)))
    say(f"{'written':<10} {told.out / PAGE}")
    return [each.name for each in outcomes if each.why]


def _outcome(name: str, job: Job, why: str) -> "Outcome":
    from slam.output.comparison.batch import Outcome

    summary = None if why else job.summary
    return Outcome(name, summary or {}, why or ("" if summary else _NOT_HERE))


def _job(told: Arguments, named: NamedRecording, out: Path) -> Job:
    folder = str(out / named.name)
    asked = (named.recording, "--recognizer", from_anywhere(told.recognizer))
    typed = (*asked, "--out", folder, "--config", str(out / SETTINGS))
    if told.save is None:
        return Job(folder, typed)
    saved = str(told.save.resolve() / named.name)
    return Job(folder, (*typed, "--save", saved), saved)


def _refuse_what_was_run_otherwise(told: Arguments, jobs: dict[str, Job]) -> None:
    """Refuse to have runs in one table that were not made alike, or to do them again.

    Raises:
        SlamError: there is one.
    """
    from slam.output.comparison.batch import summary_of_done, what_differs

    for name, job in jobs.items():
        summary = summary_of_done(Path(job.folder))
        if summary is None:
            continue
        command = ["run_slam", *job.typed[:3]]
        if differs := what_differs(Path(job.folder), summary, command, told.settings):
            raise SlamError(
                f"the run {name} is done, and not as asked for now: {differs}; choose another"
                f" folder with --out, or remove what is to be done again: {job.folder}"
            )


def _write_settings(out: Path, settings: Config, names: Container[str]) -> None:
    """Write the settings, which tell that the other files beside them are ours.

    Raises:
        LoopcloseError: a run, or somebody's file, has the name of one, or they cannot be written.
    """
    from slam.output.comparison.batch import FIGURES, PAGE

    file, first_line = out / SETTINGS, f"# {PROG}\n"
    ours = (SETTINGS, FIGURES, PAGE)
    if taken := [name for name in ours if name in names]:
        raise SlamError(f"no run can be called {taken[0]}, which is written beside the runs")
    taken = [name for name in ours if os.path.lexists(out / name)]
    if taken and not (is_file(file) and read_text(file, kind=SlamError).startswith(first_line)):
        raise SlamError(
            f"the folder holds a {taken[0]} that is not known to be of a batch; choose another with"
            f" --out: {out}"
        )
    write_atomically(file, f"{first_line}\n{to_toml(settings)}")


def _run(jobs: dict[str, Job], fleet: Fleet) -> dict[str, str]:
    """Do runs, and return why those that failed did, by name."""
    note(f"running on {len(jobs)} of the recordings, by {fleet.where}")
    return run_named(run_alone, jobs, fleet, "running", "recording")


def run_alone(job: Job) -> str:
    """Do a run as `run_slam` does, unless it is done; return why it failed, "" where it did not.

    Raises:
        Interrupted: the process was asked to end.
    """
    _wait_for(Path(job.folder))
    if job.summary is not None:  # whoever did it died before it could say so
        return ""
    main = import_module("slam.__main__").main  # above this file; in this process, it is what runs
    said = io.StringIO()
    try:
        with redirect_stderr(said), redirect_stdout(io.StringIO()):
            code = main(list(job.typed))
    except Exception as error:
        return cause_of(error)
    why = "" if code == 0 else said.getvalue().splitlines()[-1].removeprefix(_SAID)
    if why.startswith(_INTERRUPTED):
        raise Interrupted(why)
    return why


def _wait_for(folder: Path) -> None:
    """Wait, for a while, until whoever still writes to a folder has let go of it."""
    from slam.output.claimed_folder import locked

    for _ in range(_PATIENCE_S):
        try:
            os.close(locked(folder, "the folder"))
            return
        except FileNotFoundError:
            return
        except SlamError:
            time.sleep(1.0)
