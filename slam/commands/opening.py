# SPDX-License-Identifier: Apache-2.0
"""How what was named is opened: a sequence rendered, found, or fetched, and poses read."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from placerec.commands.console import note, progress_bar
from slam.config import Config, InputConfig

if TYPE_CHECKING:
    from slam.datasets import Sequence, Sessions
    from slam.datasets.pose_files import PoseFile

DEFAULT_RECOGNIZER = "learned"
DEMO = "demo"
_log = logging.getLogger("slam")


def opened(name: str, config: InputConfig, folder: Path) -> "Sequence":
    """Return a sequence, and warn of what is odd about it; the demo is kept in the folder.

    Raises:
        LoopcloseError: there is none of that name, or it cannot be read.
    """
    from slam.datasets import open_sequence, resolve

    if name != DEMO:
        with progress_bar("fetching", unit="B") as progress:
            path = resolve(name, progress)
    elif not (path := folder / "sequence").exists():
        from slam.demo.separate_process import render_apart

        with progress_bar("rendering", unit="frame") as progress:
            render_apart(path, progress)
    note(f"reading {path}")
    sequence = open_sequence(path, config)
    for warning in sequence.warnings:  # now, for they may tell why the run fails
        _log.warning("%s", warning)
    return sequence


def given_poses(
    file: Path | None, sessions: "Sessions", settings: Config
) -> tuple["PoseFile | None", Config]:
    """Return the poses to be corrected, and where on their body the camera is if they tell.

    Raises:
        LoopcloseError: the file cannot be read.
    """
    from slam.datasets.pose_files import read_odometry

    if file is None:
        return None, settings
    poses = read_odometry(file, sessions.timestamps_s, settings.input)
    for warning in poses.warnings:
        _log.warning("%s", warning)
    if poses.T_base_cam is not None and settings.odometry.T_base_cam is None:
        odometry = settings.odometry.model_copy(update={"T_base_cam": poses.T_base_cam})
        settings = settings.model_copy(update={"odometry": odometry})
    return poses, settings
