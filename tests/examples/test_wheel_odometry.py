# SPDX-License-Identifier: Apache-2.0
import io
from contextlib import redirect_stdout
from types import SimpleNamespace

import numpy as np
import pytest

from slam import Camera, Config, SlamError, Trajectory, compare_drift, open_sequence
from slam.datasets.pose_files import read_pose_file
from slam.demo.recording import render_sequence

pytestmark = pytest.mark.usefixtures("built_rooms")

SMALL_CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Render a round through the room and a little more, at half the demo's rate."""
    folder = tmp_path_factory.mktemp("rendered") / "round"
    render_sequence(folder, seconds=13.0, camera=SMALL_CAMERA, frames_per_s=7.5)
    return folder


@pytest.fixture(scope="module")
def robot(example):
    """Return the true mount, and the cameras of a robot that drives an eight on a floor."""
    times_s = np.arange(100) / 5.0
    walk = 0.3 * times_s
    at = np.stack([np.sin(walk), np.sin(2.0 * walk)], axis=-1)
    yaw = np.unwrap(np.arctan2(*np.gradient(at, axis=0).T[::-1]))
    base = example.in_space(times_s, np.column_stack([at, yaw]))
    T_base_cam = np.eye(4)
    T_base_cam[:3, :3] = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]
    T_base_cam[:3, 3] = example.ARM_M
    return T_base_cam, Trajectory(times_s, base.T_world_cam @ T_base_cam), base


def test_the_base_of_a_robot_on_a_floor_is_where_it_is(example, robot):
    T_base_cam, cameras, base = robot
    np.testing.assert_allclose(example.mount(cameras), T_base_cam, atol=1e-9)
    found = example.in_space(cameras.timestamps_s, example.flat(cameras))
    np.testing.assert_allclose(found.T_world_cam, base.T_world_cam, atol=1e-9)


def test_wheels_slip_in_turning_and_in_going(example, robot, monkeypatch):
    poses = example.flat(robot[1])
    slipped = example.slipping(poses)
    assert 0.05 < np.abs(slipped - poses).max() < 2.0
    monkeypatch.setattr(example, "SLIP", 0.0)
    turned_rad = np.ptp(poses[:, 2])
    assert np.ptp(example.slipping(poses)[:, 2]) == pytest.approx(1.04 * turned_rad)
    monkeypatch.setattr(example, "TURN_ERROR", 0.0)
    np.testing.assert_allclose(example.slipping(poses), poses, atol=1e-9)


def test_run_slam_reads_the_file(example, robot, tmp_path):
    _, cameras, base = robot
    example.write_planar(tmp_path / "wheels.txt", cameras.timestamps_s, example.flat(cameras))
    read = read_pose_file(tmp_path / "wheels.txt", cameras.timestamps_s)
    assert read.format.name == "planar"
    np.testing.assert_allclose(read.trajectory.T_world_cam, base.T_world_cam, atol=1e-5)


@pytest.fixture(scope="module", params=["known", "auto"])
def ran(request, example, folder, tmp_path_factory):
    """Run the command, with the mount known or not; return what it found, wrote and printed."""
    file, results, told = tmp_path_factory.mktemp("wheels") / "wheels.txt", [], io.StringIO()
    close_loops = example.close_loops
    with pytest.MonkeyPatch.context() as patch, redirect_stdout(told):
        patch.setattr(
            example, "close_loops", lambda *given: results.append(close_loops(*given)) or results[0]
        )
        example.main([str(folder), "--mount", request.param, "--wheels", str(file)])
    return SimpleNamespace(mount=request.param, result=results[0], file=file, told=told.getvalue())


def test_what_wheels_drift_goes_away(example, folder, ran):
    truth = open_sequence(folder, Config().input).ground_truth
    drift = compare_drift(ran.result, truth, Config().evaluation)
    assert drift.corrected.ate_rmse_m < 0.5 * drift.odometry.ate_rmse_m
    asked = [each for each in ran.result.warnings if "--odometry.T-base-cam" in each]
    assert len(asked) == (ran.mount == "auto")
    if asked:  # the height of the camera is not to be known from a plane
        numbers = asked[0].split("--odometry.T-base-cam ")[1].split(" (")[0]
        found = np.array(numbers.split(), float)[:2]
        np.testing.assert_allclose(found, example.ARM_M[:2], atol=0.05)


def test_command_tells_the_error_before_and_after(ran):
    assert "98 poses in" in ran.told and len(ran.file.read_text().splitlines()) == 98
    assert "ATE of the camera" in ran.told and "ATE of the base_link" in ran.told


def test_wheels_are_made_up_from_ground_truth(example, folder, tmp_path):
    for each in folder.iterdir():
        if each.name != "groundtruth.txt":
            (tmp_path / each.name).symlink_to(each)
    with pytest.raises(SlamError, match="no ground truth"):
        example.main([str(tmp_path)])
