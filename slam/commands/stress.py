# SPDX-License-Identifier: Apache-2.0
"""`run_slam stress`: a recording made worse step by step, and what is tolerated of it."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from placerec.commands import usage
from placerec.commands.console import note, progress_bar, say
from placerec.recognizer import load
from slam import __version__
from slam.commands.opening import DEFAULT_RECOGNIZER, opened
from slam.config import Config, load_config
from slam.types import SlamError

if TYPE_CHECKING:
    from slam.datasets import Sessions
    from slam.output.stress.folder import StressFolder
    from slam.output.stress.trials import Bench

PROG = "run_slam stress"
_DESCRIPTION = """Make a recording worse step by step, and see what is tolerated of it.

  run_slam stress demo                             all of it: some ten minutes
  run_slam stress fr1_desk --only false-loops,false-clusters,odometry-noise

These are decided again from one clean run, in seconds each. Tracked again are
dropped-frames, missing-depth, blur, darkness and moving-object. Whoever stops
goes on with the same command. Writes tolerance.png, .svg, .csv and .json."""


@dataclass(frozen=True)
class Arguments:
    """What run_slam stress was asked to do."""

    sequence: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="SEQUENCE")]
    """Folder of a recording, ROS bag, TUM RGB-D name, or `demo`."""
    only: Annotated[str | None, tyro.conf.arg(metavar="NAMES")] = None
    """What to try of the above, names joined by commas."""
    seed: Annotated[int, tyro.conf.arg(metavar="NUMBER")] = 0
    """Of everything random; the same gives the same bytes."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for the outputs, runs/SEQUENCE-stress unless told."""
    recognizer: Annotated[str, tyro.conf.arg(metavar="NAME")] = DEFAULT_RECOGNIZER
    """As for run_slam."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """TOML file with the settings of all runs."""


def main(typed: list[str]) -> int:
    """Try what was asked for and return the exit code 0.

    Raises:
        LoopcloseError: something is wrong with what was typed, or with the recording.
    """
    told = usage.parsed(Arguments, PROG, _DESCRIPTION, typed)
    from slam.output.stress.stressors import chosen

    names = chosen(told.only)
    if told.seed < 0:
        raise SlamError(f"--seed {told.seed}: it has to be 0 or more")
    config = Config() if told.config is None else load_config(told.config)
    folder = told.out or Path("runs") / f"{Path(told.sequence).resolve().name}-stress"
    try:
        _stress(told, names, config, folder)
    except KeyboardInterrupt:
        raise SlamError(f"interrupted; the same command goes on from what is in {folder}") from None
    return 0


def _stress(told: Arguments, names: list[str], config: Config, folder: Path) -> None:
    # Loaded from here on, so that --help and typing errors answer at once.
    from slam.datasets import Sessions
    from slam.geometry.features import search_images_on_one_thread
    from slam.output.claimed_folder import ClaimedFolder
    from slam.output.comparison.tables import as_text
    from slam.output.stress.folder import StressFolder
    from slam.output.stress.plots import curves
    from slam.output.stress.tolerance import as_files, table

    search_images_on_one_thread()
    with ClaimedFolder(folder):
        kept = StressFolder(folder)
        asked: dict[str, object] = {
            "sequence": told.sequence,
            "recognizer": told.recognizer,
            "seed": told.seed,
            "settings": config.model_dump(mode="json"),
            "loopclose": __version__,
        }
        load(told.recognizer)  # before the demo is rendered for one that there is not
        sessions = Sessions([opened(told.sequence, config.input, folder)])
        asked["length"] = len(sessions.timestamps_s)  # a recording of that name may be another
        kept.begin(asked)  # from here on the folder is not left empty
        bench = _bench(told, config, sessions, kept)
        _try(bench, names, kept)
        clean, trials = bench.clean_outcome(), kept.trials()
        kept.write({**as_files(clean, trials, asked), **curves(clean, trials)})
        title = f"{told.sequence} under stress, seed {told.seed}"
        say(as_text(table(title, clean, trials)))
        say(f"{'written':<10} {folder / 'tolerance.png'}, .svg, .csv and .json")


def _bench(told: Arguments, config: Config, sessions: "Sessions", kept: "StressFolder") -> "Bench":
    """Return the recording with its clean run, which is done unless it was kept."""
    from slam.output.stress.clean_run import decide, measure
    from slam.output.stress.stressors import CLEAN
    from slam.output.stress.trials import Bench

    if not kept.clean.exists():
        recognizer = load(told.recognizer)
        with progress_bar(CLEAN, len(sessions.timestamps_s), "frame") as progress:
            measure(sessions, recognizer, config, (told.sequence, PROG), progress, kept.clean)
    clean = decide(kept.clean, config)
    if not clean.has_truth:
        note("there is no ground truth: paths are compared with that of the clean run")
    return Bench(sessions, told.recognizer, config, told.seed, clean)


def _try(bench: "Bench", names: list[str], kept: "StressFolder") -> None:
    """Make the trials that were not kept, one after the other, and keep each at once.

    Raises:
        LoopcloseError: nothing can be tried, or a trial cannot be made or kept.
    """
    from slam.output.stress.stressors import STRESSORS

    obstacles = {name: why for name in names if (why := bench.obstacle(name))}
    for name, why in obstacles.items():
        note(f"{name} is not tried: {why}")
    if len(obstacles) == len(names) and not kept.trials():
        raise SlamError("there is nothing to try")
    todo = [
        (name, level)
        for name in names
        if name not in obstacles
        for level in STRESSORS[name].levels
        if kept.trial(name, level) is None
    ]
    for number, (name, level) in enumerate(todo, start=1):
        title = f"{number} of {len(todo)}: {name} {level:g}"
        with progress_bar(title, len(bench.sessions.timestamps_s), "frame") as progress:
            kept.keep(bench.tried(name, level, progress))
