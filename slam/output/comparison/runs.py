# SPDX-License-Identifier: Apache-2.0
"""Folders of finished runs, read to be compared: what was run, with which settings, what came."""

import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from placerec.datasets.names import benchmark_name
from placerec.files import is_file, is_folder, read_json, read_toml
from slam.datasets.pose_files import read_trajectory
from slam.output.claimed_folder import UNFINISHED
from slam.types import SlamError, Trajectory

ESTIMATES = {
    "odometry": "odometry",
    "live": "live",
    "without loops": "without_loops",
    "with loops": "corrected",
    "smoothed": "smoothed",
}
"""All of a run, and what they are called in the keys of its summary."""
_SAME = 0.5
_LARGEST = 1e12  # of what a summary tells
_AGAIN = ("replay", "more-loops")  # of a run, whose recording the command does not name
_SUMMARY, _SETTINGS, _TRUTH = "summary.json", "settings.toml", "groundtruth.txt"


@dataclass(frozen=True)
class FinishedRun:
    """What a run left in its folder.

    Attributes:
        name: of the folder, or its path where others have the same.
        sequence: names of its recordings, joined by +; empty where the summary does not tell.
        summary: summary.json.
        settings: by section.name; the recognizer and the given odometry with them.
        trajectories: by the names of `ESTIMATES`, those that were kept.
        truth: that it was compared with; None without.
    """

    name: str
    sequence: str
    summary: dict[str, object]
    settings: dict[str, str]
    trajectories: dict[str, Trajectory]
    truth: Trajectory | None

    @property
    def final(self) -> Trajectory:
        """The poses in the end, with loops."""
        return list(self.trajectories.values())[-1]

    @property
    def tells_rotations(self) -> bool:
        """Whether the truth says how the camera turned: without that no loop could be judged."""
        return "loops_false" not in self.summary or self.summary["loops_false"] is not None

    def number(self, key: str) -> float | None:
        """Return a number of the summary, None where there is none."""
        value = self.summary.get(key)
        if isinstance(value, bool) or not isinstance(value, int | float):
            return None
        return float(value) if abs(value) < _LARGEST else None  # which no NaN is, either

    @property
    def session_starts_s(self) -> list[float] | None:
        """When each recording after the first starts; None where the summary does not tell."""
        starts = self.summary.get("session_starts_s")
        if isinstance(starts, list) and all(type(each) in (int, float) for each in starts):
            return sorted(float(each) for each in starts if abs(each) < _LARGEST)
        sessions = self.number("sessions")
        return None if sessions is not None and sessions > 1.0 else []

    @property
    def warnings(self) -> int | None:
        """How many it gave; None where the summary does not tell."""
        warnings = self.summary.get("warnings")
        return len(warnings) if isinstance(warnings, list) else None


@dataclass(frozen=True)
class Group:
    """Runs of one sequence."""

    sequence: str
    runs: tuple[FinishedRun, ...]

    @property
    def differing(self) -> dict[str, tuple[str, ...]]:
        """The settings that are not the same in all runs, by name: one value a run."""
        names = sorted({name for run in self.runs for name in run.settings})
        values = {
            name: tuple(run.settings.get(name, "not told") for run in self.runs) for name in names
        }
        return {name: each for name, each in values.items() if len(set(each)) > 1}


def read_runs(folders: Sequence[Path]) -> list[Group]:
    """Read the folders of runs, those of one sequence together, in the order given.

    Raises:
        LoopcloseError: a folder is of no finished run, or named twice, or what it holds cannot be
            read.
    """
    places = [folder.resolve() for folder in folders]
    for i, folder in enumerate(folders):
        if places[i] in places[:i]:
            raise SlamError(f"the run is named twice; name each once: {folder}")
    names = [place.name for place in places]
    runs = [
        _read_run(folder, name if names.count(name) == 1 else str(folder))
        for folder, name in zip(folders, names, strict=True)
    ]
    groups: list[list[FinishedRun]] = []
    for run in runs:
        group = next((each for each in groups if _is_of_one_sequence(run, each[0])), None)
        if group is None:
            groups.append([run])
        else:
            group.append(run)
    return [Group(_name(group), tuple(group)) for group in groups]


def _name(runs: list[FinishedRun]) -> str:
    return next((run.sequence for run in runs if run.sequence), "an unnamed sequence")


def _is_of_one_sequence(a: FinishedRun, b: FinishedRun) -> bool:
    """Whether two runs are of one name and of one time: other recordings may be called alike.

    Without a name, most of their images have to be of the same times.
    """
    of_a, of_b = a.final.timestamps_s, b.final.timestamps_s
    if not a.sequence or not b.sequence:
        return bool(np.isin(of_a, of_b).mean() > _SAME)
    return a.sequence == b.sequence and of_a[0] <= of_b[-1] and of_b[0] <= of_a[-1]


def _read_run(folder: Path, name: str) -> FinishedRun:
    if not is_file(folder / _SUMMARY):
        if is_folder(folder / UNFINISHED):
            raise SlamError(
                "the run is not finished; wait for it, or if it was killed,"
                f" `run_slam {shlex.quote(str(folder))} --finish` makes its outputs: {folder}"
            )
        raise SlamError(
            f"there is no run: {_SUMMARY} is missing; give folders that run_slam wrote: {folder}"
        )
    summary = read_summary(folder)
    sequence, settings = _told(summary.get("command"))
    tables = read_toml(folder / _SETTINGS, kind=SlamError) if is_file(folder / _SETTINGS) else {}
    settings |= in_one(tables)
    last = "smoothed" if _is_smoothed(summary, tables) else "with loops"
    files = {"odometry": "odometry.txt", last: "trajectory.txt"}
    trajectories = {each: _poses(folder / file) for each, file in files.items()}
    # Where the run itself could not be compared with the truth, nobody should.
    is_compared = summary.get("ate_corrected_m", 0.0) is not None and is_file(folder / _TRUTH)
    truth = _poses(folder / _TRUTH) if is_compared else None
    return FinishedRun(name, sequence, summary, settings, trajectories, truth)


def read_summary(folder: Path) -> dict[str, object]:
    """Return the summary of the run in a folder.

    Raises:
        LoopcloseError: it cannot be read.
    """
    summary = read_json(folder / _SUMMARY, kind=SlamError)
    if not isinstance(summary, dict):
        raise SlamError(f"{_SUMMARY} is none that run_slam wrote: {folder}")
    return summary


def in_one(tables: Mapping[str, object]) -> dict[str, str]:
    """Return settings, which are tables by section, by section.name."""
    return {
        f"{section}.{key}": str(value)
        for section, values in tables.items()
        if isinstance(values, dict)
        for key, value in values.items()
    }


def _is_smoothed(summary: dict[str, object], settings: dict[str, object]) -> bool:
    """Whether trajectory.txt is: the summary only tells of a run that was compared with truth.

    Poses of an odometry from elsewhere are never smoothed, whatever the settings are.
    """
    if summary.get("ate_corrected_m") is not None:
        return summary.get("ate_smoothed_m") is not None
    motion = settings.get("motion")
    is_asked_for = isinstance(motion, dict) and motion.get("smooth") is True
    return is_asked_for and summary.get("given_poses") is None


def _poses(file: Path) -> Trajectory:
    return read_trajectory(file).trajectory


def _told(command: object) -> tuple[str, dict[str, str]]:
    """Return the sequence's name, and what of the command is told by flags."""
    try:
        words = shlex.split(command) if isinstance(command, str) else []
    except ValueError:  # an open quote
        words = []
    first_flag = next((i for i, word in enumerate(words) if word.startswith("--")), len(words))
    named = [Path(word).name for word in words[1:first_flag]]
    if named and named[0] in _AGAIN:
        return "", {named[0]: " ".join(words[2:first_flag])}
    flags, values = words[first_flag::2], words[first_flag + 1 :: 2]
    told = {flag.removeprefix("--"): value for flag, value in zip(flags, values, strict=False)}
    return "+".join(benchmark_name(name) or name for name in named), told
