# SPDX-License-Identifier: Apache-2.0
"""The folder of one run: what is written there, in which order."""

import json
import uuid
from pathlib import Path

import numpy as np

from placerec.errors import printable
from placerec.files import is_file, write_atomically
from slam.config import Config, to_toml
from slam.datasets.pose_files import PoseFile, write_pose_file
from slam.evaluation.drift import DriftReport
from slam.evaluation.trajectory import write_tum
from slam.output.ledger import write_ledger
from slam.output.point_cloud import write_map
from slam.output.report.page import write_report
from slam.output.summary import summarise
from slam.pose_graph import write_g2o
from slam.result import GivenOdometry, SlamResult
from slam.types import Link, RelativePose, SlamError, Trajectory

_CORRECTED = "corrected_odometry"


def make_run_folder(folder: Path) -> None:
    """Create the folder, or make sure that an existing one can be written to.

    Raises:
        SlamError: it cannot be created or written to, or it holds a recording.
    """
    if is_file(folder / "rgb.txt"):
        raise SlamError(
            f"the outputs would replace files of the recording in this folder; choose another with"
            f" --out: {folder}"
        )
    probe = folder / f".{uuid.uuid4().hex}"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise SlamError(
            f"cannot write to the output folder (choose another with --out): {error.strerror}:"
            f" {folder}"
        ) from error


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
    """Write every output of a run; what cannot be computed again comes first.

    Files that an earlier run left there and this one does not make are removed.

    The folder is made where there is none; the config is the one that it ran with. Drift and truth
    (the true camera poses) are None where there are none. The title is the report's; the command,
    what was typed but for the settings, heads settings.toml and the summary. The corrected poses of
    an odometry from elsewhere are written as those of the pose file are, else in the TUM format.

    Raises:
        LoopcloseError: the folder is a recording's, or a file cannot be written; those before it
            are complete.
    """
    make_run_folder(folder)
    if (folder / "summary.json").exists():
        for name in ("groundtruth.txt", "map.ply", "map_odom.txt", f"{_CORRECTED}.*"):
            for file in folder.glob(name):  # this run may not make them
                file.unlink()
    settings = f"# {printable(command)} --config settings.toml\n\n{to_toml(config)}"
    keyframe_s = np.array([keyframe.timestamp_s for keyframe in result.keyframes])
    of_keyframe = np.isin(result.trajectory.timestamps_s, keyframe_s)
    loops = [
        Link(attempt.match_id, attempt.query_id, attempt.outcome)
        for attempt in result.attempts
        if isinstance(attempt.outcome, RelativePose)
    ]
    write_tum(folder / "trajectory.txt", result.trajectory)
    write_tum(folder / "odometry.txt", result.odometry)
    # From the trajectory: the two files say the same of a keyframe, also where it is smoothed.
    keyframes = Trajectory(
        result.trajectory.timestamps_s[of_keyframe], result.trajectory.T_world_cam[of_keyframe]
    )
    write_tum(folder / "keyframes.txt", keyframes)
    if result.given:
        _write_given(folder, result.given, pose_file)
    truth = drift.truth if drift else truth  # as it was compared with
    if truth is not None:
        write_tum(folder / "groundtruth.txt", truth)
    write_ledger(folder / "loops.jsonl", result, drift)
    steps = result.given.steps if result.given else ()
    write_g2o(folder / "pose_graph.g2o", result.T_world_kf, [*result.links, *steps, *loops])
    write_atomically(folder / "settings.toml", settings)
    summary = {"command": command, **summarise(result, drift)}
    write_atomically(folder / "summary.json", json.dumps(summary, indent=2) + "\n")
    write_report(folder / "report.html", result, drift, settings, title, truth)
    if config.map.write:
        write_map(folder / "map.ply", result, config.map)


def _write_given(folder: Path, given: GivenOdometry, pose_file: PoseFile | None) -> None:
    stamps_s = given.corrected.timestamps_s
    if pose_file:
        file = folder / f"{_CORRECTED}{pose_file.format.ending}"
        write_pose_file(file, pose_file, given.corrected)
    else:
        write_tum(folder / f"{_CORRECTED}.txt", given.corrected)
    write_tum(folder / "map_odom.txt", Trajectory(stamps_s, given.T_map_odom))
