# SPDX-License-Identifier: Apache-2.0
"""What README and docs say of comparing can be typed as it stands there."""

import json
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from slam.__main__ import main as run_slam
from slam.commands.drift_report import main as drift_report
from slam.datasets.pose_formats import FORMATS
from slam.evaluation.trajectory import write_tum
from slam.geometry import se3
from slam.types import Trajectory

ROOT = Path(__file__).parents[3]
PAGES = (ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md")))
COMMANDS = sorted(
    {
        line.strip()
        for page in PAGES
        for line in page.read_text().splitlines()
        if re.match(r"    (drift_report|run_slam compare) ", line)
    }
)
STAMPS_S = 0.1 * np.arange(300)
WAY = np.linspace(0.0, 20.0, 300)[:, None] * np.array([0.1, -0.2, 0.3, 20.0, 9.0, 0.0])


@pytest.fixture
def recorded(tmp_path, monkeypatch):
    """A folder with poses and runs of the names that are used."""
    monkeypatch.chdir(tmp_path)
    truth = Trajectory(STAMPS_S, se3.exp(WAY))
    write_tum(Path("truth.txt"), truth)
    shutil.copy("truth.txt", "estimate.txt")
    rows = [" ".join(map(str, FORMATS[1].numbers(T))) for T in truth.T_world_cam]
    for name in ("kitti.txt", "kitti_truth.txt"):
        Path(name).write_text("\n".join(rows))
    for name in ("demo", "strict"):
        folder = Path("runs") / name
        folder.mkdir(parents=True)
        for file in ("odometry.txt", "trajectory.txt", "groundtruth.txt"):
            write_tum(folder / file, truth)
        (folder / "summary.json").write_text(json.dumps({"command": "run_slam demo"}))


def test_there_are_some():
    assert len(COMMANDS) >= 6


@pytest.mark.parametrize("command", COMMANDS)
def test_it_works(recorded, capsys, command):
    prog, *typed = shlex.split(command)
    assert {"drift_report": drift_report, "run_slam": run_slam}[prog](typed) == 0
    assert "APE (m)" in capsys.readouterr().out
