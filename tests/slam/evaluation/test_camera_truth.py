# SPDX-License-Identifier: Apache-2.0
import re

import numpy as np
import pytest

from slam.evaluation.camera_truth import camera_truth
from slam.geometry import se3
from slam.types import SlamError, Trajectory

TOLERANCE_S = 0.02
BODY = np.eye(4)
BODY[:3, :3] = [[0, -1, 0], [0, 0, -1], [1, 0, 0]]  # x ahead, y left, z up
ARM = np.eye(4)
ARM[:3, 3] = [0.1, -0.05, 0.2]
MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


RATES = (0.9, 0.7, 1.3, 0.5, 0.8, 0.3)


def walk(stamps_s, rates=RATES):
    """A hand that carries a camera about: it turns and moves all the time, and never the same."""
    sizes = np.array([0.5, 0.6, 0.2, 0.8, 0.5, 0.9])
    tangents = sizes * np.sin(np.outer(stamps_s, rates) + np.arange(6.0))
    poses = se3.exp(tangents)
    poses[:, :3, 3] = tangents[:, 3:]
    return Trajectory(stamps_s, poses)


TRUTH = walk(np.arange(0.0, 30.0, 0.01))


def estimate(noise=0.002, every=10):
    seen = walk(np.arange(5.0, 25.0, 0.01 * every))
    off = np.random.default_rng(3).normal(0.0, noise, (len(seen), 6))
    return Trajectory(seen.timestamps_s, seen.T_world_cam @ se3.exp(off))


def w_first(poses):
    turned = poses.copy()
    as_read = np.roll(se3.to_quaternion(poses[:, :3, :3]), 1, axis=-1)
    turned[:, :3, :3] = se3.from_quaternion(as_read)
    return turned


def scaled(poses, factor):
    return Trajectory(np.zeros(0), poses).enlarged(factor).T_world_cam


def assert_is_the_cameras(found, within_m, within_rad):
    """All loops and steps of the truth are those of the camera."""
    at = np.searchsorted(found.trajectory.timestamps_s, np.arange(6.0, 24.0, 0.5) - 1e-6)
    stamps_s, poses = found.trajectory.timestamps_s[at], found.trajectory.T_world_cam[at]
    right = walk(stamps_s).T_world_cam
    off = se3.inverse(se3.inverse(right[0]) @ right) @ se3.inverse(poses[0]) @ poses
    assert se3.translation_norm(off).max() < within_m
    assert se3.rotation_angle(off).max() < within_rad


@pytest.mark.parametrize("noise", [0.0, 0.002, 0.02])
def test_truth_of_the_camera_comes_back_as_it_is(noise):
    found = camera_truth(estimate(noise), TRUTH, TOLERANCE_S)
    assert found.trajectory.T_world_cam.tobytes() == TRUTH.T_world_cam.tobytes()
    assert found.trajectory.timestamps_s.tobytes() == TRUTH.timestamps_s.tobytes()
    assert (found.doubts, found.unjudged, found.scale) == ((), "", 1.0)


@pytest.mark.parametrize(
    ("late_s", "poses", "said"),
    [
        (0.0, TRUTH.T_world_cam @ BODY, r"turned by 120\.\d deg and 0\.\d cm away"),
        (0.0, TRUTH.T_world_cam @ ARM, r"turned by 0\.\d deg and 2[23]\.\d cm away"),
        (0.0, TRUTH.T_world_cam @ BODY @ ARM, r"turned by 120\.\d deg and 2[23]\.\d cm away"),
        (0.0, w_first(TRUTH.T_world_cam), "its quaternions are w x y z"),
        (0.0, se3.inverse(TRUTH.T_world_cam), "its poses take the world to the camera"),
        (0.0, scaled(TRUTH.T_world_cam, 1000.0), "it is in millimetres"),
        (0.0, scaled(TRUTH.T_world_cam @ ARM, 100.0), "it is in centimetres; it is of a body"),
        (0.0, MIRROR @ TRUTH.T_world_cam @ MIRROR, "its axes are mirrored, those of a left-handed"),
        (0.2, TRUTH.T_world_cam, r"its clock is 0\.(200|199|201) s later than the images'"),
        (-0.2, TRUTH.T_world_cam, r"its clock is 0\.(200|199|201) s earlier than the images'"),
        (1.7e9, TRUTH.T_world_cam, r"its clock is 1(7|69)\d+\.\d+ s later than the images'"),
    ],
    ids=[
        "body",
        "arm",
        "both",
        "w first",
        "inverted",
        "mm",
        "cm",
        "mirror",
        "late",
        "early",
        "epoch",
    ],
)
def test_truth_of_something_else_is_read_as_what_it_is(late_s, poses, said):
    found = camera_truth(estimate(), Trajectory(TRUTH.timestamps_s + late_s, poses), TOLERANCE_S)
    (doubt,) = found.doubts
    assert re.search(said, doubt)
    assert doubt.endswith("it was compared with as the camera's")
    assert not found.unjudged
    assert found.scale == 1.0
    assert_is_the_cameras(found, 0.02, 0.01)


def test_positions_alone_judge_nothing_that_turns():
    poses = TRUTH.T_world_cam.copy()
    poses[:, :3, :3] = np.eye(3)
    found = camera_truth(estimate(), Trajectory(TRUTH.timestamps_s, poses), TOLERANCE_S)
    assert "positions alone" in found.unjudged
    assert found.doubts == (
        f"{found.unjudged}; it cannot say whether loops are right, nor relative errors",
    )
    np.testing.assert_array_equal(found.trajectory.T_world_cam, poses)


def test_positions_mirrored_alone_are_mirrored_back():
    poses = TRUTH.T_world_cam.copy()
    poses[:, 2, 3] *= -1.0
    found = camera_truth(estimate(), Trajectory(TRUTH.timestamps_s, poses), TOLERANCE_S)
    assert "are mirrored, its orientations are not" in found.unjudged
    apart_m = np.linalg.norm(np.diff(found.trajectory.T_world_cam[:, :3, 3], axis=0), axis=1)
    right_m = np.linalg.norm(np.diff(TRUTH.T_world_cam[:, :3, 3], axis=0), axis=1)
    np.testing.assert_allclose(apart_m, right_m, atol=1e-12)
    assert np.linalg.det(found.trajectory.T_world_cam[:, :3, :3]).min() > 0.0


def test_truth_of_another_recording_judges_nothing():
    found = camera_truth(estimate(), walk(TRUTH.timestamps_s, RATES[::-1]), TOLERANCE_S)
    assert "does not turn and move as the camera does" in found.unjudged


@pytest.mark.parametrize("factor", [0.2, 1.05, 1.31, 5.0])
def test_a_path_that_is_too_long_or_too_short_says_how_much(factor):
    found = camera_truth(estimate().enlarged(factor), TRUTH, TOLERANCE_S)
    assert found.scale == pytest.approx(factor, rel=0.01)
    assert found.trajectory.T_world_cam.tobytes() == TRUTH.T_world_cam.tobytes()
    assert not found.unjudged


def test_how_far_away_a_body_is_is_told_in_the_truths_metres_not_the_images():
    of_a_body = Trajectory(TRUTH.timestamps_s, TRUTH.T_world_cam @ ARM)
    found = camera_truth(estimate().enlarged(1.2), of_a_body, TOLERANCE_S)
    assert_is_the_cameras(found, 0.02, 0.01)


def test_of_few_frames_the_unit_is_told_by_the_way_alone():
    seen = estimate()
    few = Trajectory(seen.timestamps_s[:8], seen.T_world_cam[:8])
    found = camera_truth(few, TRUTH.enlarged(1000.0), TOLERANCE_S)
    assert found.doubts == ("the ground truth is in millimetres; it was compared with in metres",)
    np.testing.assert_allclose(found.trajectory.T_world_cam, TRUTH.T_world_cam, atol=1e-9)


def test_truth_that_does_not_move_is_refused_unless_the_camera_does_not():
    still = Trajectory(TRUTH.timestamps_s, np.tile(np.eye(4), (len(TRUTH), 1, 1)))
    with pytest.raises(SlamError, match="stays in one place, while the images show"):
        camera_truth(estimate(), still, TOLERANCE_S)
    steady = Trajectory(estimate().timestamps_s, still.T_world_cam[: len(estimate())])
    assert camera_truth(steady, still, TOLERANCE_S).doubts == ()


def test_gaps_are_taken_out_first():
    poses = TRUTH.T_world_cam @ BODY
    poses[1000:1100] = np.eye(4)
    found = camera_truth(estimate(), Trajectory(TRUTH.timestamps_s, poses), TOLERANCE_S)
    assert len(found.trajectory) == len(TRUTH) - 100
    assert "gaps in the ground truth" in found.doubts[0]
    assert "turned by 120" in found.doubts[1]


def test_too_few_poses_tell_nothing():
    for seen, truth in ((estimate(), 2), (estimate(), 0), (Trajectory(np.zeros(0), BODY[:0]), 9)):
        few = Trajectory(TRUTH.timestamps_s[:truth], TRUTH.T_world_cam[:truth])
        assert camera_truth(seen, few, TOLERANCE_S).trajectory is few


def test_a_long_run_is_looked_at_in_pieces():
    truth = walk(np.arange(0.0, 600.0, 0.05))
    seen = Trajectory(truth.timestamps_s[::2], truth.T_world_cam[::2])
    assert camera_truth(seen, truth, TOLERANCE_S).doubts == ()
    of_body = Trajectory(truth.timestamps_s, truth.T_world_cam @ BODY)
    assert "turned by 120.0 deg" in camera_truth(seen, of_body, TOLERANCE_S).doubts[0]
