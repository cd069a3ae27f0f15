# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from slam.config import EvaluationConfig
from slam.evaluation.motion_truth import RIGHT_MEDIAN_NEES, judge_links, judge_loops, nees
from slam.geometry import se3
from slam.types import (
    Keyframe,
    Link,
    LoopAttempt,
    Rejection,
    RejectionReason,
    RelativePose,
    Trajectory,
    Verification,
)

CONFIG = EvaluationConfig()


def moved(x=0.0, y=0.0, z=0.0, turn_deg=0.0):
    """A pose at x, y, z, turned about the z axis."""
    T = se3.exp(np.array([0.0, 0.0, np.deg2rad(turn_deg), 0.0, 0.0, 0.0]))
    T[:3, 3] = [x, y, z]
    return T


def along(stamps_s, poses):
    return Trajectory(np.asarray(stamps_s, dtype=np.float64), np.stack(poses))


def keyframe(index, timestamp_s):
    return Keyframe(index, timestamp_s, np.eye(4), None, None)


def attempt(T_match_query, query_id=1, match_id=0):
    motion = RelativePose(T_match_query, np.eye(6))
    seen = Verification(motion, np.zeros((3, 4)), np.ones(3, dtype=np.bool_), np.zeros((3, 3)))
    return LoopAttempt(query_id, match_id, 0.9, seen, motion)


def rejected(reason, verification=None):
    return LoopAttempt(1, 0, 0.1, verification, Rejection(reason, 0.1, 0.5))


TRUE_MOTION = moved(0.3, 0.4, turn_deg=20.0)
KEYFRAMES = (keyframe(0, 0.0), keyframe(1, 5.0), keyframe(2, 7.5))
T_MOCAP = se3.exp(np.array([0.7, -0.2, 0.4, 3.0, 2.0, 1.0]))
LOOP_TRUTH = along([0.01, 5.01, 7.0], [T_MOCAP, T_MOCAP @ TRUE_MOTION, T_MOCAP])


def judged(*attempts):
    return judge_loops(attempts, KEYFRAMES, LOOP_TRUTH, CONFIG)


def test_a_right_loop_is_not_false():
    (loop,) = judged(attempt(TRUE_MOTION @ moved(0.03, 0.04, turn_deg=2.0)))
    assert loop.translation_error_m == pytest.approx(0.05)
    assert loop.rotation_error_deg == pytest.approx(2.0)
    assert loop.true_distance_m == pytest.approx(0.5)
    assert loop.true_angle_deg == pytest.approx(20.0)
    assert loop.is_false is False


@pytest.mark.parametrize("off", [moved(0.11), moved(turn_deg=5.1)])
def test_a_loop_off_in_place_or_in_angle_is_false(off):
    assert judged(attempt(TRUE_MOTION @ off))[0].is_false is True
    assert judged(attempt(se3.inverse(TRUE_MOTION)))[0].is_false is True


def test_loops_that_are_not_in_use_are_not_false():
    wrong = attempt(moved(5.0))
    by_similarity, outvoted = judged(
        rejected(RejectionReason.LOW_SIMILARITY),
        rejected(RejectionReason.OUTVOTED, wrong.verification),
    )
    assert math.isnan(by_similarity.translation_error_m)
    assert by_similarity.true_distance_m == pytest.approx(0.5)
    assert outvoted.translation_error_m > 4.0
    assert by_similarity.is_false is None
    assert outvoted.is_false is None


def test_loops_without_truth_at_both_keyframes_are_unknown():
    (loop,) = judged(attempt(TRUE_MOTION, query_id=2))
    assert loop.is_false is None
    assert math.isnan(loop.true_distance_m)
    assert math.isnan(loop.translation_error_m)


# How large errors are against what they claim


def test_errors_count_in_the_standard_deviations_that_the_motion_claims():
    information = np.diag([1 / 0.01**2, 1e4, 1e4, 1 / 0.02**2, 2500.0, 2500.0])
    measured = RelativePose(TRUE_MOTION @ se3.exp(np.array([0.01, 0, 0, 0.06, 0, 0])), information)
    assert nees(measured, TRUE_MOTION) == pytest.approx(1.0 + 9.0)
    assert nees(RelativePose(TRUE_MOTION, information), TRUE_MOTION) == pytest.approx(0, abs=1e-9)


def test_the_error_is_in_the_query_camera_s_axes():
    # The claim is exact along the query's x, vague along its y; it is turned by 90 degrees.
    T_ref_query = moved(1.0, turn_deg=90.0)
    information = np.diag([1.0, 1.0, 1.0, 1e4, 1.0, 1.0])
    along_x = RelativePose(T_ref_query @ moved(0.1), information)
    along_y = RelativePose(T_ref_query @ moved(0.0, 0.1), information)
    assert nees(along_x, T_ref_query) == pytest.approx(100.0)
    assert nees(along_y, T_ref_query) == pytest.approx(0.01)


def test_motions_that_are_as_wrong_as_they_claim_have_the_right_median():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6)) * np.repeat([100.0, 50.0], 3)[:, None]
    information = root.T @ root
    errors = np.linalg.solve(root, rng.normal(size=(6, 4000))).T
    found = [nees(RelativePose(TRUE_MOTION @ se3.exp(e), information), TRUE_MOTION) for e in errors]
    assert np.median(found) == pytest.approx(RIGHT_MEDIAN_NEES, rel=0.05)


def test_links_are_judged_where_truth_covers_both_keyframes():
    off = RelativePose(TRUE_MOTION @ moved(0.3), 100.0 * np.eye(6))
    links = (Link(0, 1, off), Link(1, 2, off), Link(0, 1, RelativePose(TRUE_MOTION, np.eye(6))))
    found = judge_links(links, KEYFRAMES, LOOP_TRUTH, CONFIG)
    np.testing.assert_allclose(found, [9.0, np.nan, 0.0], atol=1e-9)
    assert judge_links((), KEYFRAMES, LOOP_TRUTH, CONFIG).shape == (0,)


def test_loops_carry_theirs_though_they_are_not_in_use():
    off = attempt(TRUE_MOTION @ moved(0.3))
    outvoted = rejected(RejectionReason.OUTVOTED, off.verification)
    unmeasured = rejected(RejectionReason.LOW_SIMILARITY)
    elsewhere = attempt(TRUE_MOTION, query_id=2)
    accepted, refused, without, unknown = judged(off, outvoted, unmeasured, elsewhere)
    assert accepted.nees == refused.nees == pytest.approx(0.09)
    assert math.isnan(without.nees) and math.isnan(unknown.nees)


def test_truth_is_taken_at_the_keyframe_s_time_and_not_beside_it():
    # Truth every 10 ms of a camera that turns by 200 degrees a second; the keyframe is between two.
    turning = along([0.0, 4.995, 5.005], [np.eye(4), moved(turn_deg=9.0), moved(turn_deg=11.0)])
    (loop,) = judge_loops([attempt(moved(turn_deg=10.0))], KEYFRAMES[:2], turning, CONFIG)
    assert loop.rotation_error_deg == pytest.approx(0.0, abs=1e-9)
