# SPDX-License-Identifier: Apache-2.0
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from placerec import load
from slam import Camera, Config, Frame, SlamError, Trajectory, open_sequence

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
EXAMPLE = Path(__file__).parents[2] / "examples/two_robots.py"


@pytest.fixture(scope="module")
def sequence(recording):
    return open_sequence(recording, Config().input)


@pytest.fixture(scope="module")
def frames(sequence):
    return list(sequence)


def two(example, folder, camera=CAMERA):
    return [example.Robot(name, folder, camera, load("gradients")) for name in example.NAMES]


@pytest.fixture(scope="module")
def met(example, frames, tmp_path_factory, needs_lancedb):
    """Return two robots that went one half each, frame by frame, and a record of what they knew."""
    robots = two(example, tmp_path_factory.mktemp("met"))
    knew = []
    for pair in zip(frames[:30], frames[30:], strict=True):
        for robot, frame in zip(robots, pair, strict=True):
            robot.take(frame)
        knew.append([(len(each.loops), each.T_map_odom()) for each in robots])
    for robot in robots:
        robot.finish()
    for robot in robots:
        assert robot.wait(0.0)
        robot.listen()
    return robots, knew


def true_T_map_world(sequence):
    """Return where the world of the robot with the second half is in that of the other."""
    T_world_cam, times_s = sequence.ground_truth.T_world_cam, sequence.ground_truth.timestamps_s
    first, second = np.searchsorted(times_s, sequence.timestamps_s[[0, 30]] - 1e-3)
    return np.linalg.inv(T_world_cam[first]) @ T_world_cam[second]


def test_both_learn_on_the_way_where_they_are_in_one_map(met, sequence):
    (one, other), knew = met
    assert knew[0] == [(0, None), (0, None)]
    np.testing.assert_allclose(knew[-1][0][1], np.eye(4), atol=0.05)  # corrected by its own loops
    np.testing.assert_allclose(knew[-1][1][1], true_T_map_world(sequence), atol=0.05)
    np.testing.assert_array_equal(one.T_map_world, np.eye(4))
    np.testing.assert_allclose(other.T_map_world, true_T_map_world(sequence), atol=0.03)


def test_both_have_the_same_loops_in_the_end(met):
    (one, other), _ = met
    mine, theirs = (
        {(each.ref_id, each.query_id): each.motion.T_ref_query for each in robot.loops}
        for robot in (one, other)
    )
    assert mine.keys() == theirs.keys()
    assert all(np.array_equal(mine[pair], theirs[pair]) for pair in mine)


def test_a_keyframe_survives_being_sent(example, met, tmp_path):
    (one, _), _ = met
    lens = replace(CAMERA, distortion=(0.1, -0.2, 0.0, 0.01, 0.0))
    (kept, *_) = sorted((one._shared / "robot1/keyframes").glob("*.npz"))
    keyframe = example.read_keyframe(kept)
    example.write_keyframe(tmp_path / "robot1/again.npz", keyframe, lens)
    again = example.read_keyframe(tmp_path / "robot1/again.npz")
    assert (again.id, again.timestamp_s, again.camera) == (keyframe.id, keyframe.timestamp_s, lens)
    for name, array in vars(keyframe.features).items():
        np.testing.assert_array_equal(getattr(again.features, name), array)
        assert getattr(again.features, name).dtype == array.dtype


def mirrored(frame):
    """Return a frame of a room that the recording does not show, though it looks like it."""
    return Frame(frame.timestamp_s, frame.rgb[:, ::-1].copy(), frame.depth_m[:, ::-1].copy())


def test_robots_that_saw_nothing_in_common_get_no_place(
    example, frames, tmp_path, capsys, needs_lancedb
):
    one, other = two(example, tmp_path)
    for frame in frames[:16:2]:
        one.take(frame)
    one.finish()
    assert not example.drive(other, map(mirrored, frames[:16:2]), tmp_path, patience_s=0.0)
    told = capsys.readouterr().out
    assert re.fullmatch(
        r"robot2  no T_map_odom: [1-9]\d* pairs of views looked alike, 0 of them were verified as"
        r" loops; loops have to agree at two places\n",
        told,
    )
    assert not (tmp_path / "robot2/trajectory.txt").exists()


def test_who_is_alone_says_so(example, frames, tmp_path, capsys, needs_lancedb):
    robot, _ = two(example, tmp_path)
    assert not example.drive(robot, frames[:3], tmp_path, patience_s=0.0)
    first, second = capsys.readouterr().out.splitlines()
    assert first == f"robot1  robot2 never came: nothing of it is in {tmp_path}"
    assert second.startswith("robot1  no T_map_odom: 0 pairs of views looked alike")


def test_what_a_robot_said_stays_when_it_dies(
    example, sequence, frames, tmp_path, capsys, needs_lancedb
):
    dead, robot = two(example, tmp_path)
    for frame in frames[:30]:
        dead.take(frame)
    assert example.drive(robot, frames[30:], tmp_path, patience_s=0.0)
    told = capsys.readouterr().out
    assert re.search(
        r"after \d\.\d s: T_map_odom is .* m, turned by .* degrees, by \d+ loops", told
    )
    assert "robot1 was silent for 0 s; what it said until then stays" in told
    np.testing.assert_allclose(robot.T_map_world, true_T_map_world(sequence), atol=0.05)


def test_what_is_damaged_is_one_line(example, tmp_path):
    for content in (b"", b"PK", b"no archive"):
        (tmp_path / "report.npz").write_bytes(content)
        with pytest.raises(SlamError, match="cannot be read; begin anew"):
            example.Report.read(tmp_path / "report.npz")
    with pytest.raises(SlamError, match="cannot be read; begin anew"):
        example.read_keyframe(tmp_path / "none.npz")


@pytest.mark.parametrize("alone", [[], ["--robot", "robot2"]])
def test_a_folder_that_was_used_is_refused(example, recording, tmp_path, alone):
    (tmp_path / "robot2").mkdir()
    with pytest.raises(SlamError, match="robot2 was here before"):
        example.main([str(recording), "--shared", str(tmp_path), *alone])


def test_the_error_is_that_of_all_in_one_frame(example):
    rng = np.random.default_rng(0)
    T = np.tile(np.eye(4), (2, 20, 1, 1))
    T[:, :, :3, 3] = rng.normal(size=(2, 20, 3))
    truths = [Trajectory(np.arange(20.0), each) for each in T]
    turned = np.array([[0.0, -1.0, 0.0, 5.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
    T_map_truth = np.vstack([turned, [0.0, 0.0, 0.0, 1.0]])
    paths = [
        Trajectory(each.timestamps_s + 0.004, T_map_truth @ each.T_world_cam) for each in truths
    ]
    assert example.ate_mm(paths, truths) == pytest.approx(0.0, abs=1e-4)
    apart = T_map_truth @ paths[1].T_world_cam
    assert example.ate_mm([Trajectory(np.arange(20.0), apart)], truths[1:]) < 1e-4
    assert example.ate_mm([paths[0], Trajectory(np.arange(20.0), apart)], truths) > 500.0


def started(*arguments):
    command = [sys.executable, str(EXAMPLE), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True)


def test_two_processes_meet_and_the_error_of_both_is_told(recording, tmp_path, needs_lancedb):
    ended = started(recording, "--shared", tmp_path / "shared")
    assert (ended.returncode, ended.stderr) == (0, "")
    for name in ("robot1", "robot2"):
        assert re.search(rf"{name}  after .*: T_map_odom is ", ended.stdout)
        assert (tmp_path / "shared" / name / "trajectory.txt").is_file()
    (error_mm,) = re.findall(r"ATE of the poses in the end: (.*) mm in one frame", ended.stdout)
    assert 0.0 < float(error_mm) < 20.0


def test_what_cannot_be_run_is_one_line(tmp_path):
    ended = started(tmp_path / "none", "--shared", tmp_path / "shared")
    assert ended.returncode == 2
    assert ended.stderr.count("\n") == 1
    assert ended.stdout == ""
