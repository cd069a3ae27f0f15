# SPDX-License-Identifier: Apache-2.0
"""How what was named is opened: settings and poses read, a sequence rendered, found, or fetched."""

import logging
from argparse import ArgumentParser
from pathlib import Path
from typing import TYPE_CHECKING

from placerec.commands.console import note, progress_bar
from slam.config import Config, InputConfig, load_config

if TYPE_CHECKING:
    from slam.datasets import Sequence, Sessions
    from slam.datasets.pose_files import PoseFile

DEFAULT_RECOGNIZER = "learned"
DEMO = "demo"
_log = logging.getLogger("slam")


def settings_file_typed(typed: list[str]) -> Config:
    """Return the settings of --config, which are the defaults of the other flags.

    Raises:
        LoopcloseError: the file cannot be used.
    """
    finder = ArgumentParser(add_help=False, allow_abbrev=False)
    finder.add_argument("--config", type=Path, nargs="?")  # tyro tells what it lacks
    path: Path | None = finder.parse_known_args(typed)[0].config
    return Config() if path is None else load_config(path)


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
