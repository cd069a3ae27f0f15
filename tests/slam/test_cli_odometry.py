# SPDX-License-Identifier: Apache-2.0
"""`run_slam FOLDER --odometry POSES`, from the file of poses to the folder of outputs."""

import json
import shutil
import sys

import numpy as np
import pytest

from slam.__main__ import main
from slam.evaluation.trajectory import read_tum, write_tum
from slam.external_odometry.odometry import ExternalOdometry
from slam.geometry import se3
from slam.types import Trajectory

QUICK = ("--map.write", "False", "--recognizer", "gradients")


@pytest.fixture
def run_slam(tmp_path, monkeypatch, capsys):
    """Return what runs the command in this process, in an empty folder: (code, out, err)."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))

    def run(*arguments):
        code = main([*map(str, arguments), "--out", str(tmp_path / "out"), *QUICK])
        captured = capsys.readouterr()
        return code, captured.out, captured.err

    return run


@pytest.fixture
def folder(short_recording):
    return short_recording()


@pytest.fixture
def truth(folder):
    """Return a true pose for each image."""
    images = (folder / "rgb.txt").read_text().splitlines()
    truth, count = read_tum(folder / "groundtruth.txt"), sum(line[0] != "#" for line in images)
    cut = Trajectory(truth.timestamps_s[:count], truth.T_world_cam[:count])
    write_tum(folder / "poses.txt", cut)
    return cut


def complaint(ran):
    code, _, err = ran
    assert code == 2 and "Traceback" not in err
    (line,) = [each for each in err.splitlines() if each.startswith("run_slam: ")]
    return line


def test_the_poses_come_back_corrected_beside_the_usual_outputs(run_slam, folder, truth, tmp_path):
    poses = folder / "poses.txt"
    code, out, _ = run_slam(folder, "--odometry", poses)
    assert code == 0 and "given      the odometry, compared with" in out
    out_folder = tmp_path / "out"
    corrected = read_tum(out_folder / "corrected_odometry.txt")
    np.testing.assert_array_equal(corrected.timestamps_s, truth.timestamps_s)
    np.testing.assert_allclose(corrected.T_world_cam[0], truth.T_world_cam[0], atol=1e-6)
    T_map_odom = read_tum(out_folder / "map_odom.txt").T_world_cam
    np.testing.assert_allclose(T_map_odom @ truth.T_world_cam, corrected.T_world_cam, atol=1e-5)
    before = read_tum(out_folder / "odometry.txt")  # theirs, not ours
    steps = [se3.inverse(T[:-1]) @ T[1:] for T in (before.T_world_cam, truth.T_world_cam)]
    np.testing.assert_allclose(*steps, atol=1e-5)
    summary = json.loads((out_folder / "summary.json").read_text())
    assert summary["given_poses"] == len(truth)
    assert summary["given_verdict"].startswith("the odometry, compared with")
    assert f"--odometry {poses}" in (out_folder / "settings.toml").read_text()
    assert "The odometry, compared with" in (out_folder / "report.html").read_text()
    run_slam(folder)  # the next run makes none
    assert not list(out_folder.glob("corrected*")) and not (out_folder / "map_odom.txt").exists()


def test_images_without_a_pose_of_their_own_cost_no_other_its_pose(
    run_slam, folder, truth, monkeypatch
):
    kept = np.setdiff1d(np.arange(len(truth)), [2, 4, 5])
    write_tum(folder / "poses.txt", Trajectory(*(each[kept] for each in vars(truth).values())))
    at, asked = ExternalOdometry.at, []

    def recorded(self, timestamp_s):
        asked.append((at(self, timestamp_s), self._given.last_s - timestamp_s))
        return asked[-1][0]

    monkeypatch.setattr(ExternalOdometry, "at", recorded)
    run_slam(folder, "--odometry", folder / "poses.txt")
    assert len(asked) == len(truth)
    assert all(T is not None for T, _ in asked)
    # No more than one later than the image is handed over.
    assert max(early_s for _, early_s in asked) < 3.1 * np.median(np.diff(truth.timestamps_s))


def test_poses_come_back_as_they_are_written(run_slam, folder, truth, tmp_path):
    lines = [" ".join(f"{value:.9e}" for value in T[:3].ravel()) for T in truth.T_world_cam]
    (tmp_path / "kitti.txt").write_text("\n".join(lines) + "\n")
    assert run_slam(folder, "--odometry", "kitti.txt")[0] == 0
    rows = np.loadtxt(tmp_path / "out" / "corrected_odometry.txt")
    assert rows.shape == (len(truth), 12)
    np.testing.assert_allclose(rows[0], truth.T_world_cam[0, :3].ravel(), atol=1e-6)


def test_settings_say_how_the_poses_are_to_be_read(run_slam, folder, truth, tmp_path):
    T_base_cam = se3.from_rotation_translation(
        se3.from_quaternion(np.array([-0.5, 0.5, -0.5, 0.5])), np.array([0.1, 0.0, 0.3])
    )
    body = Trajectory(truth.timestamps_s, truth.T_world_cam @ se3.inverse(T_base_cam))
    write_tum(tmp_path / "base.txt", body)
    mount = ("0.1", "0", "0.3", "-0.5", "0.5", "-0.5", "0.5")
    flag = "--odometry.T-base-cam"
    code, _, _ = run_slam(folder, "--odometry", "base.txt", flag, *mount)
    assert code == 0
    before = read_tum(tmp_path / "out" / "odometry.txt")
    steps = [se3.inverse(T[:-1]) @ T[1:] for T in (before.T_world_cam, truth.T_world_cam)]
    np.testing.assert_allclose(*steps, atol=1e-5)
    corrected = read_tum(tmp_path / "out" / "corrected_odometry.txt")
    np.testing.assert_allclose(corrected.T_world_cam[0], body.T_world_cam[0], atol=1e-6)
    assert main([str(folder), "--config", str(tmp_path / "out" / "settings.toml")]) == 0


@pytest.mark.parametrize(
    ("content", "told"),
    [
        ("", "holds no pose"),
        ("1 2 3\n4 5 6\n", "line 1 has 3 numbers"),
        ("100 0 0 0 0 0 0 1\n100.1 nan 0 0 0 0 0 1\n", "line 2"),
        ("5 0 0 0 0 0 0 1\n6 0 0 0 0 0 0 1\n", "no time in common"),
        (
            "".join(f"{100 + i / 10} {i % 2} 0 0 0 0 0 1\n" for i in range(20)),
            "two frames or two bodies are mixed",
        ),
    ],
    ids=["empty", "3 columns", "NaN", "another day", "two frames mixed"],
)
def test_poses_that_cannot_be_used(run_slam, folder, tmp_path, content, told):
    (tmp_path / "poses.txt").write_text(content)
    line = complaint(run_slam(folder, "--odometry", "poses.txt"))
    assert told in line and "poses.txt" in line
    assert not (tmp_path / "out").exists()


def test_poses_that_are_not_there(run_slam, folder):
    assert "nowhere.txt" in complaint(run_slam(folder, "--odometry", "nowhere.txt"))


def test_poses_of_another_recording_cost_nothing_that_the_images_tell(
    run_slam, recording, tmp_path
):
    truth, rng = read_tum(recording / "groundtruth.txt"), np.random.default_rng(0)
    T = np.cumsum(rng.normal(size=(len(truth), 6)), axis=0)
    write_tum(tmp_path / "other.txt", Trajectory(truth.timestamps_s, se3.exp(T)))
    line = complaint(run_slam(recording, "--odometry", "other.txt"))
    assert "do not fit the images" in line and "what the images alone tell is in" in line
    shutil.move(tmp_path / "out" / "trajectory.txt", tmp_path / "with.txt")
    assert run_slam(recording)[0] == 0
    alone, beside = (read_tum(tmp_path / each) for each in ("out/trajectory.txt", "with.txt"))
    np.testing.assert_allclose(beside.T_world_cam, alone.T_world_cam, atol=2e-3)


def test_the_same_poses_give_the_same_bytes(run_slam, folder, tmp_path):
    poses, made = folder / "groundtruth.txt", ("trajectory.txt", "loops.jsonl")
    written = []
    for _ in range(2):
        assert run_slam(folder, "--odometry", poses)[0] == 0
        names = (*made, "corrected_odometry.txt", "map_odom.txt")
        written.append([(tmp_path / "out" / name).read_bytes() for name in names])
    assert written[0] == written[1]
