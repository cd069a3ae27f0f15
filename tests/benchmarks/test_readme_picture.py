# SPDX-License-Identifier: Apache-2.0
"""The README's picture is drawn from a run's folder."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from slam.config import Config, to_toml
from slam.evaluation.trajectory import write_tum
from slam.types import Trajectory

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "readme_picture.py"


@pytest.fixture
def run_folder(tmp_path: Path) -> Path:
    T_world_cam = np.tile(np.eye(4), (30, 1, 1))
    T_world_cam[:, :3, 3] = np.random.default_rng(0).normal(size=(30, 3))
    for name in ("groundtruth", "odometry", "trajectory"):
        write_tum(tmp_path / f"{name}.txt", Trajectory(np.arange(30.0), T_world_cam))
    (tmp_path / "settings.toml").write_text(to_toml(Config()))
    (tmp_path / "loops.jsonl").touch()
    return tmp_path


def draw(run: Path, picture: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, SCRIPT, run, picture]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_same_run_same_picture(run_folder: Path):
    pictures = [run_folder / "once.svg", run_folder / "twice.svg"]
    for picture in pictures:
        assert draw(run_folder, picture).returncode == 0
    once, twice = (picture.read_bytes() for picture in pictures)
    assert once == twice
    assert b"<svg" in once


def test_run_without_ground_truth_is_refused_in_one_line(run_folder: Path):
    (run_folder / "groundtruth.txt").unlink()
    done = draw(run_folder, run_folder / "picture.svg")
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1
    assert "groundtruth.txt" in done.stderr
    assert not (run_folder / "picture.svg").exists()
