# SPDX-License-Identifier: Apache-2.0
"""The folder of one run: what is written there, in which order."""

import json
import logging
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from placerec.errors import Salvage, cause_of, printable
from placerec.files import write_atomically
from slam.config import Config, MapConfig, to_toml
from slam.datasets.pose_files import PoseFile, write_pose_file
from slam.evaluation.drift import DriftReport
from slam.evaluation.trajectory import write_tum
from slam.geometry.freed_memory import give_back
from slam.output.claimed_folder import ClaimedFolder
from slam.output.ledger.writing import write_ledger
from slam.output.mesh.separate_process import MESHES, meshes_apart
from slam.output.point_cloud import write_map
from slam.output.replay.measurements import MEASUREMENTS, Measurements, write_measurements
from slam.output.summary import summarise
from slam.result import GivenOdometry, SlamResult
from slam.types import Link, RelativePose, SlamError, Trajectory

_log = logging.getLogger(__name__)
_Writer = Callable[[Path], None]


def write_run(
    folder: Path,
    result: SlamResult,
    drift: DriftReport | None,
    truth: Trajectory | None,
    config: Config,
    title: str,
    command: str,
    pose_file: PoseFile | None = None,
) -> None:
    """Write every output of a run, and put all at once in the place of an earlier run's.

    The folder is made where there is none; the config is the one that it ran with. Drift and truth
    (the true camera poses) are None where there are none. The title is the report's; the command,
    what was typed but for the settings, heads settings.toml and the summary. The corrected poses of
    an odometry from elsewhere are written as those of the pose file are, else in the TUM format.

    Raises:
        LoopcloseError: the folder is a recording's, holds a file that would be replaced and is of
            no run, or another run is writing to it; or files cannot be written: the others are.
    """
    with ClaimedFolder(folder) as claimed:
        claimed.start()
        write_outputs(claimed, result, drift, truth, config, title, command, pose_file)


def write_outputs(
    claimed: ClaimedFolder,
    result: SlamResult,
    drift: DriftReport | None,
    truth: Trajectory | None,
    config: Config,
    title: str,
    command: str,
    pose_file: PoseFile | None = None,
    measured: Measurements | None = None,
    problems: Sequence[str] = (),
) -> SlamResult:
    """Write every output as `write_run` does, into a folder that is claimed already.

    What the run measured is written where it is given, and its problems go into the summary.
    Returns the result with the meshes, or with a warning that says why there are none, if the
    config asks for them.

    Raises:
        LoopcloseError: files cannot be written; the others are complete and in their place.
    """
    settings = settings_file(command, config)
    truth = drift.truth if drift else truth  # as it was compared with
    writers: dict[str, _Writer] = {
        "trajectory.txt": lambda path: write_tum(path, result.trajectory),
        "odometry.txt": lambda path: write_tum(path, result.odometry),
        "keyframes.txt": lambda path: write_tum(path, _keyframes(result)),
    }
    if result.given:
        writers |= _of_given(result.given, pose_file)
    if truth is not None:
        writers["groundtruth.txt"] = lambda path: write_tum(path, truth)
    if measured is not None:
        writers[MEASUREMENTS] = lambda path: write_measurements(path, measured)
    writers |= {
        "loops.jsonl": lambda path: write_ledger(path, result, drift),
        "pose_graph.g2o": lambda path: _write_graph(path, result),
        "settings.toml": lambda path: write_atomically(path, settings),
    }
    salvage = Salvage()
    claimed.unfinished.mkdir(parents=True, exist_ok=True)  # somebody may have removed it
    _write(claimed.unfinished, writers, salvage)  # what cannot be computed again comes first
    if config.map.mesh and result.has_images:
        result = _with_meshes(claimed.unfinished, result, config.map)
    meshes = [name for name in MESHES if (claimed.unfinished / name).exists()]
    later: dict[str, _Writer] = {
        "summary.json": lambda path: _write_summary(
            path, result, drift, command, [*writers, *meshes, *later], problems
        )
    }
    if config.map.write and result.has_images:  # before the memory that the report takes is taken
        later["map.ply"] = lambda path: write_map(path, result, config.map)
    later["report.html"] = lambda path: _write_report(path, result, drift, settings, title)
    _write(claimed.unfinished, later, salvage)
    claimed.complete()
    if salvage.missing:
        why = next(iter(salvage.missing.values()))
        raise SlamError(f"missing: {', '.join(salvage.missing)}: {why}")
    return result


def _write(folder: Path, writers: dict[str, _Writer], salvage: Salvage) -> None:
    for name, write in writers.items():
        path = folder / name
        salvage.attempt(name, partial(write, path), None)
        if name in salvage.missing:  # what the run had of it so far is not what it is called
            path.unlink(missing_ok=True)
        give_back()  # what one took, the next one need not take anew


def begin_outputs(
    claimed: ClaimedFolder, config: Config, command: str, truth: Trajectory | None
) -> None:
    """Begin a run with those of its outputs that are known; it is finished with them if killed.

    Those of an earlier run that was killed are gone then, with a warning.

    Raises:
        LoopcloseError: they cannot be written.
    """
    if claimed.start():
        _log.warning("an earlier run into this folder was killed, and this one replaces it")
    write_atomically(claimed.unfinished / "settings.toml", settings_file(command, config))
    if truth is not None:
        write_tum(claimed.unfinished / "groundtruth.txt", truth)


def settings_file(command: str, config: Config) -> str:
    """Return settings.toml: the command that made a run, and the settings that it ran with."""
    return f"# {printable(command)} --config settings.toml\n\n{to_toml(config)}"


def _keyframes(result: SlamResult) -> Trajectory:
    # From the trajectory: the two files say the same of a keyframe, also where it is smoothed.
    keyframe_s = np.array([keyframe.timestamp_s for keyframe in result.keyframes[result.earlier :]])
    chosen = np.isin(result.trajectory.timestamps_s, keyframe_s)
    return Trajectory(result.trajectory.timestamps_s[chosen], result.trajectory.T_world_cam[chosen])


def _of_given(given: GivenOdometry, pose_file: PoseFile | None) -> dict[str, _Writer]:
    corrected, T_map_odom = given.corrected, given.T_map_odom
    ending = pose_file.format.ending if pose_file else ".txt"

    def write(path: Path) -> None:
        if pose_file:
            write_pose_file(path, pose_file, corrected)
        else:
            write_tum(path, corrected)

    return {
        f"corrected_odometry{ending}": write,
        "map_odom.txt": lambda path: write_tum(
            path, Trajectory(corrected.timestamps_s, T_map_odom)
        ),
    }


def _with_meshes(folder: Path, result: SlamResult, config: MapConfig) -> SlamResult:
    """Write the meshes; a run is worth more than they, so that what fails is a warning."""
    try:
        meshes = meshes_apart(folder, result, config)
    except Exception as error:
        for name in MESHES:
            (folder / name).unlink(missing_ok=True)
        warning = f"there are no meshes: {cause_of(error)}"
        return replace(result, warnings=(*result.warnings, warning))
    finally:
        give_back()
    return replace(result, meshes=meshes, warnings=(*result.warnings, *meshes.warnings))


def _write_report(
    path: Path,
    result: SlamResult,
    drift: DriftReport | None,
    settings: str,
    title: str,
) -> None:
    # Loaded here, because it takes time and memory that tracking does without.
    from slam.output.report.page import write_report

    write_report(path, result, drift, settings, title)


def _write_graph(path: Path, result: SlamResult) -> None:
    loops = [
        Link(attempt.match_id, attempt.query_id, attempt.outcome)
        for attempt in result.attempts
        if isinstance(attempt.outcome, RelativePose)
    ]
    steps = result.given.steps if result.given else ()
    from slam.pose_graph import write_g2o

    write_g2o(path, result.T_world_kf, [*result.links, *steps, *loops])


def _write_summary(
    path: Path,
    result: SlamResult,
    drift: DriftReport | None,
    command: str,
    files: list[str],
    problems: Sequence[str],
) -> None:
    # Why the run is not what was asked for: none after a good one, whose exit code is 0.
    told = {"command": command, "files": files, "problems": list(problems)}
    summary = {**told, **summarise(result, drift)}
    write_atomically(path, json.dumps(summary, indent=2) + "\n")
