# SPDX-License-Identifier: Apache-2.0
import threading
from dataclasses import replace

import numpy as np
import pytest

from placerec.errors import RecognizerError
from placerec.recognizers.gradients import GradientRecognizer
from slam.config import Config, LoopConfig
from slam.external_odometry.comparison import GivenKeyframe
from slam.external_odometry.trust import Verdict
from slam.geometry import se3
from slam.geometry.features import FeatureExtractor, grey_of
from slam.loops.back_end import BackEnd
from slam.loops.stage_clock import StageClock
from slam.pose_graph import solve_beside
from slam.tracking.tracked_frame import preview
from slam.types import (
    Camera,
    Keyframe,
    Link,
    Rejection,
    RejectionReason,
    RelativePose,
)

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
INFORMATION = np.diag([1e6] * 3 + [1e5] * 3)


class Gate(GradientRecognizer):
    """Works only when it is let, and fails when it is told to."""

    def __init__(self):
        self.is_open = threading.Event()
        self.is_open.set()
        self.asked = 0
        self.fails_at = 0

    def embed(self, image):
        assert self.is_open.wait(10.0)
        self.asked += 1
        return np.full(496, np.nan) if self.asked == self.fails_at else super().embed(image)


def back_end(recognizer, **loop):
    return BackEnd(CAMERA, recognizer, Config(loop=LoopConfig(**loop)), StageClock())


def features_of(frame):
    extractor = FeatureExtractor(CAMERA, Config().features)
    return extractor.extract(grey_of(frame.rgb), frame.depth_m)


@pytest.fixture(scope="module")
def keyframes(frames):
    """Return keyframes 3 s apart that all show the first frame's place, and their images."""
    features = features_of(frames[0])
    return [
        (Keyframe(k, 3.0 * k, np.eye(4), features, preview(frames[0])), frames[0].rgb)
        for k in range(4)
    ]


def in_use(solved):
    return [(each.match_id, each.query_id) for each in solved.attempts if each.rejection is None]


def links(keyframe):
    if not keyframe.id:
        return ()
    return (Link(keyframe.id - 1, keyframe.id, RelativePose(np.eye(4), INFORMATION)),)


def test_who_inserts_does_not_wait_for_the_answer(keyframes):
    gate = Gate()
    behind = back_end(gate)
    gate.is_open.clear()
    keyframe, rgb = keyframes[0]
    behind.insert(keyframe, (), {}, rgb)
    assert behind.keyframes == []
    gate.is_open.set()
    assert behind.settle() == ()
    assert behind.keyframes == [keyframe]


def test_keyframes_are_taken_one_after_the_other_and_loops_weighed(keyframes):
    clock = StageClock()
    behind = BackEnd(CAMERA, Gate(), Config(loop=LoopConfig(min_gap=2)), clock)
    for keyframe, rgb in keyframes:
        behind.insert(keyframe, links(keyframe), {}, rgb)
    solved = behind.solve({})
    assert sorted(clock.seconds) == ["close loops", "correct", "describe", "graph"]
    assert all(each.weight > 0.9 for each in solved.attempts)
    assert behind.keyframes == [keyframe for keyframe, _ in keyframes]
    assert {(each.match_id, each.query_id) for each in solved.attempts} == {(0, 2), (0, 3), (1, 3)}
    assert in_use(solved) == [(each.match_id, each.query_id) for each in solved.attempts]
    np.testing.assert_allclose(solved.T_world_kf, np.tile(np.eye(4), (4, 1, 1)), atol=1e-3)
    assert behind.loop_closer.similarities().shape == (4, 4)


def test_a_keyframe_closes_no_loop_with_one_that_it_is_linked_to(keyframes):
    behind = back_end(Gate(), min_gap=2)
    motion = RelativePose(np.eye(4), INFORMATION)
    for keyframe, rgb in keyframes[:3]:
        known = [Link(k, keyframe.id, motion) for k in reversed(range(keyframe.id))]
        behind.insert(keyframe, tuple(known), {}, rgb)
    assert behind.solve({}).attempts == ()


def test_loops_that_lost_are_not_trusted(keyframes):
    behind = back_end(Gate(), min_gap=2)
    for keyframe, rgb in keyframes[:3]:
        far = np.eye(4)
        far[0, 3] = 2.0 * keyframe.id
        behind.insert(replace(keyframe, T_odom_cam=far), links(keyframe), {}, rgb)
    solved = behind.solve({})
    (lost,) = solved.attempts
    assert in_use(solved) == [] and 0.0 <= lost.weight < 0.1
    assert lost.outcome == Rejection(RejectionReason.OUTVOTED, lost.weight, 0.5)
    assert isinstance(lost.verification.outcome, RelativePose)  # what geometry saw stays known
    assert any("contradict the odometry" in each for each in solved.warnings)
    (aloud,) = [each for each in solved.warnings if each.startswith("1 of 1 loops")]
    assert RejectionReason.OUTVOTED.value in aloud


def test_a_segment_that_loops_at_one_place_tie_is_of_no_use_and_a_second_makes_it_one(
    keyframes, frames, T_first_cam
):
    behind = back_end(Gate(), min_gap=2)
    (here, rgb), other_rgb = keyframes[0], frames[24].rgb
    features = features_of(frames[24])
    elsewhere = replace(here, features=features, T_odom_cam=T_first_cam[24])
    motion = RelativePose(T_first_cam[24], INFORMATION)
    behind.insert(here, (), {}, rgb)
    behind.insert(replace(elsewhere, id=1), (Link(0, 1, motion),), {}, other_rgb)
    behind.insert(replace(here, id=2, segment=1), (), {}, rgb)
    solved = behind.solve({}, {0: 1, 2: 2})
    alone = solved.attempts[0]
    assert (alone.match_id, alone.query_id) == (0, 2)
    assert alone.outcome == Rejection(RejectionReason.UNJOINED, 1, 2) and alone.weight is None
    assert isinstance(alone.verification.outcome, RelativePose)  # what geometry saw stays known
    assert np.isnan(solved.T_world_kf[:2]).all() and np.isfinite(solved.T_world_kf[2]).all()
    assert in_use(solved) == []
    behind.insert(replace(elsewhere, id=3, segment=1), (Link(2, 3, motion),), {}, other_rgb)
    solved = behind.solve({})
    assert np.isfinite(solved.T_world_kf).all()
    assert in_use(solved) == [(0, 2), (1, 3)]
    assert [(link.ref_id, link.query_id) for link in solved.links] == [(0, 1), (0, 2), (2, 3)]


def drifting(keyframes):
    """Return the keyframes, in truth all at one place, as an odometry that drifts sees them."""
    step = np.eye(4)
    step[0, 3] = 0.02
    T_odom_cam = [np.linalg.matrix_power(step, each.id) for each, _ in keyframes]
    motion = RelativePose(step, np.diag([1e4] * 3 + [1e3] * 3))
    for (keyframe, rgb), T in zip(keyframes, T_odom_cam, strict=True):
        tie = (Link(keyframe.id - 1, keyframe.id, motion),) if keyframe.id else ()
        yield replace(keyframe, T_odom_cam=T), tie, rgb


def test_corrections_come_by_themselves_one_after_the_other(keyframes):
    behind = back_end(Gate(), min_gap=2)
    assert not behind.corrections[-1].T_world_odom
    for keyframe, tie, rgb in drifting(keyframes):
        behind.insert(keyframe, tie, {}, rgb)
        if keyframe.id == 0:
            (first,) = behind.corrections
            assert first.version == 0 and first.newest_id == -1
            np.testing.assert_array_equal(first.T_world_odom[0], np.eye(4))
    behind.catch_up()
    # The loops say that nothing moved: the first is closed by keyframe 2, two more by keyframe 3.
    assert [each.newest_id for each in behind.corrections] == [-1, 2, 3]
    assert [each.version for each in behind.corrections] == [0, 1, 2]
    assert behind.corrections[0] is first  # what somebody holds stays what it was
    newest = behind.corrections[-1]
    assert newest.T_world_odom[0][0, 3] < -0.04  # most of 6 cm
    T_world_last = newest.T_world_odom[0] @ behind.keyframes[3].T_odom_cam
    np.testing.assert_allclose(T_world_last, newest.T_world_kf[3], atol=1e-12)
    np.testing.assert_allclose(T_world_last, behind.solve({}).T_world_kf[3], atol=1e-3)


def test_a_large_map_is_corrected_and_solved_from_its_last_correction(keyframes, monkeypatch):
    monkeypatch.setattr("slam.pose_graph.graph._SMALL", 2)
    started = []

    def beside(graph, probability, settled):
        started.append((list(graph.solved), list(settled)))
        return solve_beside(graph, probability, settled)

    monkeypatch.setattr("slam.loops.on_the_way.corrections.solve_beside", beside)
    behind = back_end(Gate(), min_gap=2)
    for keyframe, tie, rgb in drifting(keyframes):
        behind.insert(keyframe, tie, {}, rgb)
    behind.catch_up()
    assert started == [([], []), ([0, 1, 2], [0, 1, 2])]
    assert [list(each.T_world_kf) for each in behind.corrections] == [[], [], [0, 1, 2, 3]]
    newest = behind.corrections[-1]
    np.testing.assert_allclose(newest.T_world_kf[3], behind.solve({}).T_world_kf[3], atol=1e-3)


def test_a_large_map_forgets_what_older_candidates_show(keyframes, monkeypatch):
    monkeypatch.setattr("slam.loops.evidence._SHOWN_WITH_EVIDENCE", 3)
    monkeypatch.setattr("slam.loops.evidence._RECENT", 1)
    behind = back_end(Gate(), min_gap=1)
    for keyframe, rgb in keyframes:
        behind.insert(keyframe, links(keyframe), {}, rgb)
    behind.catch_up()
    seen = [each.verification for each in behind.attempts]
    assert [each.query_id for each in behind.attempts] == [2, 3, 3]
    assert [len(each.pixels) > 0 for each in seen] == [True, False, True]
    # How many matches there were, and that they agree, stays on record.
    assert [len(each.inlier_mask) for each in seen] == 3 * [len(seen[0].pixels)]
    assert in_use(behind.solve({})) == [(0, 2), (0, 3), (1, 3)]


def test_who_asks_for_the_correction_does_not_wait(keyframes, monkeypatch):
    is_let = threading.Event()

    def slow(*asked):
        assert is_let.wait(10.0)
        return solve_beside(*asked)

    monkeypatch.setattr("slam.loops.on_the_way.corrections.solve_beside", slow)
    behind = back_end(Gate(), min_gap=2)
    for keyframe, tie, rgb in drifting(keyframes):
        behind.insert(keyframe, tie, {}, rgb)
    behind.settle()  # all keyframes are taken in, although no correction is solved yet
    assert len(behind.keyframes) == 4 and len(behind.corrections) == 1
    is_let.set()
    behind.catch_up()
    assert len(behind.corrections) == 3


def test_the_first_loops_of_another_segment_do_not_wait_for_as_many_as_there_are(
    keyframes, monkeypatch
):
    monkeypatch.setattr("slam.loops.on_the_way.schedule._LOOP_GROWTH", 10.0)
    behind = back_end(Gate(), min_gap=2)
    for keyframe, rgb in keyframes:
        behind.insert(keyframe, links(keyframe), {}, rgb)
    for k in (4, 5):
        elsewhere = replace(keyframes[0][0], id=k, timestamp_s=3.0 * k, segment=1)
        behind.insert(elsewhere, links(elsewhere) if k == 5 else (), {}, rgb)
    behind.catch_up()
    # The second loop of the first segment waits for ten more, the first of the next for none.
    assert [each.newest_id for each in behind.corrections] == [-1, 2, 4]


def test_an_odometry_that_slips_slowly_does_not_outvote_the_loops(keyframes):
    """It agrees with motions over short ways, and a leap hides it from those over long ones."""
    behind, (keyframe, rgb) = back_end(Gate(), min_gap=8), keyframes[0]
    slipped = np.eye(4)
    jitter = se3.exp(np.random.default_rng(0).normal(size=(11, 6)) * np.repeat([7e-4, 2e-3], 3))
    for k in range(11):
        slipped[0, 3] += 0.2 if k == 4 else 0.004 if k > 4 else 0.0
        each = replace(keyframe, id=k, timestamp_s=3.0 * k)
        behind.insert(each, links(each), {}, rgb, GivenKeyframe(slipped @ jitter[k]))
    solved = behind.solve({})
    assert solved.trust.verdict is Verdict.CONTRADICTED
    assert solved.trust.doubted == (4,)
    assert solved.steps == ()
    assert len(in_use(solved)) == len(solved.attempts) == 6
    np.testing.assert_allclose(solved.T_world_kf, np.tile(np.eye(4), (11, 1, 1)), atol=1e-3)


def test_links_follow_the_odometry_that_moves_its_keyframes(keyframes):
    behind = back_end(Gate(), min_gap=100)
    moved = se3.exp(np.array([0.0, 0.1, 0.0, 0.3, 0.0, 0.0]))
    for keyframe, rgb in keyframes[:3]:
        behind.insert(keyframe, links(keyframe), {1: moved} if keyframe.id == 2 else {}, rgb)
    solved = behind.solve({2: moved @ moved})
    for link in solved.links:
        np.testing.assert_allclose(link.motion.T_ref_query, moved, atol=1e-12)
        np.testing.assert_array_equal(link.motion.information, INFORMATION)
    np.testing.assert_allclose(solved.T_world_kf[2], moved @ moved, atol=1e-12)
    np.testing.assert_array_equal(solved.T_world_kf, solved.T_world_kf_without)


def test_a_few_keyframes_may_stand_in_line_and_no_more(keyframes):
    gate, is_done = Gate(), threading.Event()
    behind = back_end(gate)
    first, rgb = keyframes[0]

    def insert(ids):
        for k in ids:
            keyframe = replace(first, id=k)
            behind.insert(keyframe, links(keyframe), {}, rgb)

    def insert_more():
        insert(range(8, 12))
        is_done.set()

    gate.is_open.clear()
    insert(range(8))
    waiting = threading.Thread(target=insert_more)
    waiting.start()
    assert not is_done.wait(0.05) and behind.keyframes == []
    gate.is_open.set()
    assert is_done.wait(10.0)
    behind.settle()
    assert [each.id for each in behind.keyframes] == list(range(12))


def test_after_a_failure_nothing_is_taken_in_and_whoever_asks_next_is_told(keyframes):
    gate = Gate()
    gate.fails_at = 3
    behind = back_end(gate)
    for keyframe, rgb in keyframes:
        behind.insert(keyframe, links(keyframe), {}, rgb)
    with pytest.raises(RecognizerError, match="NaN"):
        behind.settle()
    assert behind.settle() == ()
    assert [each.id for each in behind.keyframes] == [0, 1]
    assert len(behind.solve({}).T_world_kf) == 2


class Torn(Gate):
    """Compares by itself, and fails at that once."""

    def __init__(self):
        super().__init__()
        self.compared = 0

    def compare(self, queries, references):
        self.compared += 1
        if self.compared == 1:
            raise ValueError("cannot compare")
        return np.asarray(queries) @ np.asarray(references).T


def test_after_a_failure_to_compare_nothing_is_taken_in_either(keyframes):
    behind = back_end(Torn(), min_gap=2)
    for keyframe, rgb in keyframes:
        behind.insert(keyframe, links(keyframe), {}, rgb)
    with pytest.raises(RecognizerError, match="cannot compare"):
        behind.settle()
    assert len(behind.keyframes) == len(behind.solve({}).T_world_kf) == 2
    assert behind.loop_closer.similarities().shape == (2, 2)
    keyframe, rgb = keyframes[3]
    behind.insert(replace(keyframe, segment=1), (), {}, rgb)
    with pytest.raises(RecognizerError, match="cannot compare"):
        behind.settle()


def test_who_has_to_wait_for_room_is_told_of_a_failure(keyframes):
    gate = Gate()
    gate.fails_at = 1
    behind = back_end(gate)
    keyframe, rgb = keyframes[0]
    for _ in range(8):
        behind.insert(keyframe, (), {}, rgb)
    with pytest.raises(RecognizerError, match="NaN"):
        behind.insert(keyframe, (), {}, rgb)
    assert behind.is_empty


def test_an_image_is_recognized_by_all_keyframes_that_were_queued_before(keyframes, frames):
    gate, found = Gate(), []
    behind = back_end(gate)
    gate.is_open.clear()
    for keyframe, rgb in keyframes:
        behind.insert(keyframe, links(keyframe), {}, rgb)
    asking = threading.Thread(target=lambda: found.append(behind.recognize(frames[1].rgb)))
    asking.start()
    asking.join(0.05)
    assert not found
    gate.is_open.set()
    asking.join(10.0)
    assert found == [[0, 1, 2, 3]]
    assert len(behind.solve({}).T_world_kf) == 4


def test_after_a_failure_nothing_is_recognized_and_it_is_still_told(keyframes):
    gate = Gate()
    gate.fails_at = 3
    behind = back_end(gate)
    for keyframe, rgb in keyframes:
        behind.insert(keyframe, links(keyframe), {}, rgb)
    assert behind.recognize(keyframes[0][1]) == []
    with pytest.raises(RecognizerError, match="NaN"):
        behind.settle()


def test_a_failure_to_recognize_is_told_at_once_and_does_no_harm(keyframes):
    gate = Gate()
    gate.fails_at = 2
    behind = back_end(gate)
    first, rgb = keyframes[0]
    behind.insert(first, (), {}, rgb)
    with pytest.raises(RecognizerError, match="NaN"):
        behind.recognize(rgb)
    assert behind.recognize(rgb) == [0]
    assert len(behind.solve({}).T_world_kf) == 1
