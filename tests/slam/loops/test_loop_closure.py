# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from placerec.certificate import Certificate
from placerec.errors import RecognizerError
from slam.config import LoopConfig, VerificationConfig
from slam.geometry import se3
from slam.geometry.motion_noise import loop_noise, typical_depth_m
from slam.geometry.relative_pose import estimate_relative_pose
from slam.loops.loop_closure import LoopCloser
from slam.loops.verification import verify_loop
from slam.types import Frame, Keyframe, Proposal, Rejection, RejectionReason, RelativePose

T_REF_QUERY = se3.exp(np.array([0.05, -0.08, 0.03, 0.12, -0.05, 0.08]))
IMAGE = np.zeros((4, 4, 3), np.uint8)


class Scripted:
    """Sees whatever it is told to."""

    min_similarity = 0.8

    def __init__(self, *answers):
        self.answers = iter(answers)

    def embed(self, image):
        answer = next(self.answers)
        if isinstance(answer, Exception):
            raise answer
        return answer


def direction(angle_deg):
    """Return the embedding at this angle: its similarity to that at 0 is the cosine."""
    return np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))], np.float32)


def closer(recognizer=None, *, camera=None, verification=None, **loop):
    return LoopCloser(
        camera,
        recognizer or Scripted(),
        LoopConfig(**{"min_gap": 1, **loop}),
        verification or VerificationConfig(),
    )


@pytest.fixture
def views(make_views):
    return make_views(T_REF_QUERY)


def keyframe(number, features, timestamp_s=None, turning_rad_s=0.0, segment=0):
    timestamp_s = float(number) if timestamp_s is None else timestamp_s
    preview = Frame(timestamp_s, IMAGE, np.zeros((4, 4), np.float32))
    return Keyframe(number, timestamp_s, np.eye(4), features, preview, turning_rad_s, segment)


def run(loop_closer, views, angles_deg, step_s=1.0):
    """Close loops of keyframes that look in these directions; return the attempts of each."""
    return [
        loop_closer.close(keyframe(number, views.reference, number * step_s), direction(angle_deg))
        for number, angle_deg in enumerate(angles_deg)
    ]


def pairs(attempts):
    return [(attempt.query_id, attempt.match_id) for attempt in attempts]


def test_a_place_seen_again_is_a_loop_with_the_match_as_reference(views):
    loop_closer = closer(camera=views.camera)
    assert loop_closer.close(keyframe(0, views.reference, 0.0), direction(0)) == ()
    (attempt,) = loop_closer.close(keyframe(1, views.query, 10.0), direction(10))
    assert isinstance(attempt.outcome, RelativePose) and pairs([attempt]) == [(1, 0)]
    assert attempt.similarity == pytest.approx(np.cos(np.radians(10)))
    assert attempt.weight is None
    np.testing.assert_allclose(attempt.outcome.T_ref_query, T_REF_QUERY, atol=1e-6)
    assert attempt.verification.pixels.shape == (150, 4)


class Levels(Scripted):
    """Describes a place by a (1, 1) level, and compares levels by their difference."""

    looks_back = 1

    def __init__(self):
        self.asked = []

    def compare(self, queries, references):
        self.asked.append(queries.ravel().tolist())
        return 1 - abs(queries[:, None, 0, 0] - references[None, :, 0, 0])


def test_a_recognizer_that_compares_its_embeddings_itself_is_asked(views):
    levels = Levels()
    loop_closer = closer(levels, camera=views.camera, candidates=1)
    for number, level in enumerate([0.0, 0.5, 0.25]):
        new = keyframe(number, views.reference, 10.0 * number)
        attempts = loop_closer.close(new, np.full((1, 1), level, np.float32))
    assert [(attempt.match_id, attempt.similarity) for attempt in attempts] == [(0, 0.75)]
    assert levels.asked == [[0.0, 0.5], [0.5, 0.25]]
    expected = [[1, 0.5, 0.75], [0.5, 1, 0.75], [0.75, 0.75, 1]]
    assert loop_closer.similarities().tolist() == expected


def test_a_camera_that_stood_still_closes_no_loop_with_what_it_is_linked_to(views):
    loop_closer = closer(camera=views.camera, min_gap=3, candidates=10)
    run(loop_closer, views, [0] * 4, step_s=10.0)
    new = keyframe(4, views.reference, 40.0)
    assert pairs(loop_closer.close(new, direction(0), linked_ids=[3, 2])) == [(4, 0), (4, 1)]


def test_only_keyframes_outside_the_window_are_looked_at(views):
    attempts = run(closer(camera=views.camera, min_gap=3, candidates=10), views, [0] * 6)
    assert [pairs(each) for each in attempts] == [
        [],
        [],
        [],
        [(3, 0)],
        [(4, 0), (4, 1)],
        [(5, 0), (5, 1), (5, 2)],
    ]
    attempts = run(closer(camera=views.camera, min_gap=4, candidates=10), views, [0] * 5)
    assert [pairs(each) for each in attempts] == [[], [], [], [], [(4, 0)]]


def close_all(loop_closer, views, segments):
    """Close loops of keyframes a second apart that look the same, one for each segment named."""
    return [
        loop_closer.close(keyframe(k, views.reference, segment=segment), direction(k))
        for k, segment in enumerate(segments)
    ]


def test_all_keyframes_of_other_segments_are_looked_at_however_new(views):
    loop_closer = closer(camera=views.camera, min_gap=3, candidates=10)
    attempts = close_all(loop_closer, views, [0, 0, 1, 1, 0, 2])
    assert [pairs(each) for each in attempts] == [
        [],
        [],
        [(2, 1), (2, 0)],
        [(3, 1), (3, 0)],
        [(4, 3), (4, 2), (4, 1), (4, 0)],
        [(5, 4), (5, 3), (5, 2), (5, 1), (5, 0)],
    ]
    new = keyframe(6, views.reference, segment=0)
    attempts = loop_closer.close(new, direction(6), linked_ids=[4, 1])
    assert pairs(attempts) == [(6, 5), (6, 3), (6, 2), (6, 0)]


def test_no_more_of_other_segments_than_wanted(views):
    loop_closer = closer(camera=views.camera, min_gap=3, candidates=2)
    attempts = close_all(loop_closer, views, [0, 0, 1, 0, 0])
    assert [pairs(each) for each in attempts[2:]] == [
        [(2, 1), (2, 0)],
        [(3, 2), (3, 0)],
        [(4, 2), (4, 1)],
    ]


def test_every_keyframe_beyond_the_window_leaves_an_attempt(views):
    angles_deg = np.random.default_rng(0).uniform(0, 360, 40)
    attempts = run(closer(camera=views.camera, min_gap=3), views, angles_deg)
    assert all(each == () for each in attempts[:3])
    for number, each in enumerate(attempts[3:], start=3):
        assert 1 <= len(each) <= 4
        assert all(attempt.query_id == number for attempt in each)
        assert all(attempt.match_id <= number - 3 for attempt in each)


def test_the_most_similar_ones_come_first_and_no_more_than_wanted(views):
    attempts = run(
        closer(camera=views.camera, candidates=2), views, [30, 10, 20, 5, 25, 15, 90, 91, 92, 0]
    )
    assert pairs(attempts[-1]) == [(9, 3), (9, 1)]


def test_too_little_similarity_is_an_attempt_with_the_best_of_them(views):
    attempts = run(closer(camera=views.camera), views, [80, 50, 60, 120, 121, 0])
    (attempt,) = attempts[-1]
    assert pairs([attempt]) == [(5, 1)]
    assert attempt.verification is None and not isinstance(attempt.outcome, RelativePose)
    similarity = pytest.approx(np.cos(np.radians(50)))
    assert attempt.similarity == similarity
    assert attempt.outcome.reason is RejectionReason.LOW_SIMILARITY
    assert (attempt.outcome.measured, attempt.outcome.needed) == (similarity, 0.8)


def test_candidates_below_the_threshold_are_not_verified_beside_better_ones(views):
    attempts = run(closer(camera=views.camera), views, [20, 70, 80, 120, 121, 0])
    assert pairs(attempts[-1]) == [(5, 0)]


def test_the_setting_wins_over_the_recognizers_own_threshold(views):
    assert closer().min_similarity == 0.8
    lenient = closer(camera=views.camera, min_similarity=0.1)
    assert lenient.min_similarity == 0.1
    attempts = run(lenient, views, [80, 50, 60, 120, 121, 0])
    assert pairs(attempts[-1]) == [(5, 1), (5, 2), (5, 0)]
    # Zero is a threshold, not the absence of one.
    assert closer(min_similarity=0.0).min_similarity == 0.0


def test_geometry_may_say_no_to_what_looks_alike(views, make_views):
    other = make_views(T_REF_QUERY, seed=5)
    loop_closer = closer(camera=views.camera)
    loop_closer.close(keyframe(0, views.reference, 0.0), direction(0))
    (attempt,) = loop_closer.close(keyframe(1, other.query, 10.0), direction(0))
    assert attempt.outcome.reason is RejectionReason.FEW_MATCHES
    assert attempt.verification.outcome == attempt.outcome and not isinstance(
        attempt.outcome, RelativePose
    )


def test_a_blank_keyframe_is_remembered_and_rejected(views):
    blank = replace(
        views.reference, **{name: values[:0] for name, values in vars(views.reference).items()}
    )
    loop_closer = closer(camera=views.camera)
    loop_closer.close(keyframe(0, blank, 0.0), direction(0))
    (attempt,) = loop_closer.close(keyframe(1, views.query, 10.0), direction(0))
    assert attempt.outcome == Rejection(RejectionReason.FEW_MATCHES, 0, 20)


def attempt_in_a_turn(views, camera, *turning_rad_s, config=None):
    loop_closer = closer(camera=camera, verification=config or VerificationConfig())
    match_rad_s, query_rad_s = turning_rad_s
    loop_closer.close(keyframe(0, views.reference, 0.0, match_rad_s), direction(0))
    (one,) = loop_closer.close(keyframe(1, views.query, 10.0, query_rad_s), direction(0))
    return one


def test_a_loop_knows_what_the_shutter_makes_of_a_turn_and_is_not_refused_for_it(views):
    rolling = replace(views.camera, readout_s=0.02)
    seen = estimate_relative_pose(
        views.reference, views.query, views.camera, VerificationConfig()
    ).outcome
    depth_m = typical_depth_m(views.reference, views.query)
    for camera in (views.camera, rolling):
        expected = loop_noise(seen, camera, depth_m, 3.0, 2.0)
        outcome = attempt_in_a_turn(views, camera, 3.0, 2.0).outcome
        np.testing.assert_array_equal(outcome.information, expected.information)


def test_a_loop_that_says_next_to_nothing_is_refused(views):
    config = VerificationConfig(max_uncertainty=1e-5)
    rejected = attempt_in_a_turn(views, views.camera, 0.0, 0.0, config=config)
    assert rejected.outcome.reason is RejectionReason.UNCERTAIN_MOTION
    assert rejected.outcome.measured > rejected.outcome.needed == 1e-5
    # Geometry's own answer is kept: the report shows it, and truth can judge it.
    assert isinstance(rejected.verification.outcome, RelativePose)


def test_similarities_are_those_between_all_keyframes(views):
    loop_closer = closer(camera=views.camera)
    assert loop_closer.similarities().shape == (0, 0)
    run(loop_closer, views, [0, 60, 90])
    expected = np.cos(np.radians([[0, 60, 90], [60, 0, 30], [90, 30, 0]]))
    np.testing.assert_allclose(loop_closer.similarities(), expected, atol=1e-6)
    assert loop_closer.similarities().dtype == np.float32


@pytest.mark.parametrize(
    ("answers", "what"),
    [
        ([np.array([np.nan, 1.0])], "1 of 2 values that are NaN or infinite"),
        ([np.array([np.inf, 1.0])], "1 of 2 values that are NaN or infinite"),
        ([np.ones((2, 2)) / 2], r"an array of shape \(2, 2\)"),
        ([np.float32(1.0)], r"an array of shape \(\)"),
        ([np.zeros(0)], r"an array of shape \(0,\)"),
        ([direction(0), np.array([0.0, 0.0, 1.0])], r"shape \(3,\) after \(2,\)"),
        ([np.array([3.0, 4.0])], "a vector of length 5"),
        ([np.zeros(4)], "a vector of length 0"),
        ([None], r"an array of shape \(\)"),
        (["here"], "a str that is not an array of numbers"),
        ([ValueError("out of\nmemory")], "failed: ValueError: out of memory"),
    ],
)
def test_a_recognizer_that_misbehaves_is_named_in_one_line(answers, what):
    loop_closer = closer(Scripted(*answers))
    for _ in answers[:-1]:
        loop_closer.describe(IMAGE)
    with pytest.raises(RecognizerError, match=what) as error:
        loop_closer.describe(IMAGE)
    assert "Scripted" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("threshold", [np.nan, 1.5, "high", None])
def test_a_threshold_that_is_no_cosine_is_refused_at_once(threshold):
    recognizer = Scripted()
    recognizer.min_similarity = threshold
    with pytest.raises(RecognizerError, match="min_similarity"):
        closer(recognizer)


class Certified(Scripted):
    """Says that all but the opposite direction was met before."""

    fingerprint = "sha256:0"

    def __init__(self, fingerprint="sha256:0"):
        super().__init__()
        counts = ("images", "skipped", "pairs", "same_place_pairs", "threshold")
        ranges = dict.fromkeys(("different_places", "same_place"), (0.0, 1.0))
        room = {"data": "a room", "resampled": "places", **dict.fromkeys(counts, 0), **ranges}
        known = {name: () if "curve" in name else 0 for name in Certificate.model_fields}
        known |= {name: (0.0, 1.0) for name in known if name.endswith("_interval")}
        known |= {"version": 2, "recognizer": "certified", "kinds": (room,)}
        self.certificate = Certificate.model_validate(known | {"fingerprint": fingerprint})


def calibration_of(loop_closer):
    return loop_closer.calibration(loop_closer.similarities())


def test_a_certificate_is_put_beside_the_pairs_that_could_be_loops(views):
    recognizer = Certified()
    loop_closer = closer(recognizer, camera=views.camera, min_gap=3)
    run(loop_closer, views, [0, 10, 20, 30, 40])
    new = keyframe(5, views.reference, 50.0)
    loop_closer.close(new, direction(50), linked_ids=[4, 3, 2, 1])  # so 0 is the only one left
    calibration = calibration_of(loop_closer)
    assert calibration.certificate is recognizer.certificate
    angles_deg = [30 - 0, 40 - 0, 40 - 10, 50 - 0]
    np.testing.assert_allclose(
        calibration.live_similarities, np.cos(np.radians(angles_deg)), atol=1e-6
    )
    assert calibration.warnings == ()


def test_places_unlike_those_calibrated_on_are_warned_of(views):
    loop_closer = closer(Certified(), camera=views.camera, min_gap=3)
    run(loop_closer, views, [0] * 10 + [180] * 10)
    (warning,) = calibration_of(loop_closer).warnings
    assert "of the 153 similarities lie outside 0.000 to 1.000" in warning
    assert "calibrated on a room" in warning


def test_without_a_certificate_nothing_is_said(views):
    loop_closer = closer(camera=views.camera)
    run(loop_closer, views, [0] * 4)
    assert calibration_of(loop_closer) is None


def test_a_certificate_without_any_pair_to_compare_is_told_all_the_same(views):
    loop_closer = closer(Certified(), camera=views.camera)
    run(loop_closer, views, [0])
    assert len(calibration_of(loop_closer).live_similarities) == 0


def test_of_very_many_keyframes_every_other_is_compared_with_every_other(views):
    loop_closer = closer(Certified(), camera=views.camera, min_gap=3, min_similarity=1.0)
    angles_deg = np.arange(401) * 0.1
    run(loop_closer, views, angles_deg)
    similarities = loop_closer.similarities()
    gaps = np.abs(angles_deg[::2, None] - angles_deg[None, ::2])
    np.testing.assert_allclose(similarities, np.cos(np.radians(gaps)), atol=1e-6)
    calibration = calibration_of(loop_closer)
    rows, columns = np.tril_indices(201, k=-2)  # 4 apart, for the window is of 3
    np.testing.assert_array_equal(calibration.live_similarities, similarities[rows, columns])
    assert calibration.step == 2


def test_a_certificate_of_another_version_is_refused_at_once():
    with pytest.raises(RecognizerError, match="the certificate of another version"):
        closer(Certified("sha256:1"))


def test_a_certificate_is_put_beside_pairs_of_two_segments_too(views):
    loop_closer = closer(Certified(), camera=views.camera, min_gap=3)
    close_all(loop_closer, views, [0, 0, 1])
    live = calibration_of(loop_closer).live_similarities
    np.testing.assert_allclose(live, np.cos(np.radians([2, 1])), atol=1e-6)


def test_an_image_without_a_keyframe_is_compared_with_all_of_them_however_new(views):
    loop_closer = closer(camera=views.camera, candidates=3, min_similarity=0.9)
    run(loop_closer, views, [0, 60, 10, 20, 5])
    assert loop_closer.most_similar(direction(6)) == [4, 2, 0]
    assert loop_closer.most_similar(direction(60)) == [1]
    assert loop_closer.most_similar(direction(180)) == []
    assert closer().most_similar(direction(0)) == []
    assert len(loop_closer.similarities()) == 5  # it is not remembered


def test_those_of_one_segment_may_be_left_out(views):
    loop_closer = closer(camera=views.camera, candidates=2, min_similarity=0.9)
    close_all(loop_closer, views, [0, 1, 0, 1, 1])
    assert loop_closer.most_similar(direction(4), but_segment=1) == [2, 0]
    assert loop_closer.most_similar(direction(4), but_segment=0) == [4, 3]


def walk(views, count, step_m, rng, **loop):
    """Close loops of a camera that goes straight ahead, each view half new.

    Neighbours are alike by cos 45 degrees or so, and the less the more views there are between.
    """
    loop_closer = closer(Scripted(), camera=views.camera, **loop)
    attempts, last = [], np.zeros(64, np.float32)
    for number in range(count):
        each = keyframe(number, views.reference)
        T_odom_cam = se3.from_rotation_translation(np.eye(3), [number * step_m, 0.0, 0.0])
        embedding = rng.normal(0.0, 1.0, 64).astype(np.float32)
        embedding = last + embedding / np.linalg.norm(embedding)
        last = (embedding / np.linalg.norm(embedding)).astype(np.float32)
        each = replace(each, T_odom_cam=T_odom_cam)
        attempts.extend(loop_closer.close(each, last))
    return loop_closer, attempts


def test_the_threshold_moves_to_where_views_of_one_place_are_here(views):
    loop_closer, attempts = walk(views, 80, 0.5, np.random.default_rng(0), min_similarity="adapted")
    fit = loop_closer.threshold()
    assert fit.one_place_pairs == 79
    assert loop_closer.min_similarity == fit.min_similarity == fit.adapted < 0.6
    assert attempts[0].min_similarity == 0.8
    assert attempts[-1].min_similarity == pytest.approx(fit.min_similarity, abs=0.01)
    again, _ = walk(views, 80, 0.5, np.random.default_rng(0), min_similarity="adapted")
    assert again.threshold() == fit


@pytest.mark.parametrize(("given", "fixed"), [(0.75, 0.75), (None, 0.8)])
def test_a_threshold_stays_unless_it_is_to_be_adapted(views, given, fixed):
    loop_closer, attempts = walk(views, 40, 0.5, np.random.default_rng(0), min_similarity=given)
    assert loop_closer.min_similarity == loop_closer.threshold().min_similarity == fixed
    assert loop_closer.threshold().adapted < fixed
    assert {each.min_similarity for each in attempts} == {fixed}


def test_far_neighbours_are_of_no_place_that_is_known(views):
    loop_closer, _ = walk(views, 40, 0.7, np.random.default_rng(0), min_similarity="adapted")
    assert loop_closer.threshold().one_place_pairs == 0
    assert loop_closer.min_similarity == 0.8


def test_keyframes_beyond_the_known_path_say_nothing_of_one_place(views):
    loop_closer = closer(camera=views.camera, min_gap=50)
    for number in range(40):  # to and fro
        T_odom_cam = se3.from_rotation_translation(np.eye(3), [0.5 * (number % 2), 0.0, 0.0])
        each = replace(keyframe(number, views.reference), T_odom_cam=T_odom_cam)
        loop_closer.close(each, direction(0))
    # Of each, the six before it are no more than 3 m of path away.
    assert loop_closer.threshold().one_place_pairs == sum(min(k, 6) for k in range(40))
    assert loop_closer.threshold().other_pairs == 0


def test_recognizers_that_compare_sequences_keep_their_threshold(views):
    assert closer(Levels(), camera=views.camera).threshold() is None


def test_what_a_second_look_leaves_out_is_recorded_and_not_verified(views, make_views):
    other = make_views(T_REF_QUERY, seed=5).reference
    loop_closer = closer(camera=views.camera, candidates=1, second_look=10)
    for number, (features, angle_deg) in enumerate([(views.reference, 20), (other, 5)]):
        loop_closer.close(keyframe(number, features), direction(angle_deg))
    right, wrong = loop_closer.close(keyframe(2, views.query), direction(0))
    assert pairs([right, wrong]) == [(2, 0), (2, 1)]  # not the most similar first
    assert isinstance(right.outcome, RelativePose)
    assert wrong.verification is None
    assert wrong.outcome.reason is RejectionReason.SECOND_LOOK
    assert wrong.outcome.measured < wrong.outcome.needed


def test_a_second_look_is_not_taken_at_nothing(views):
    class Reranks(Scripted):
        def rerank(self, query, candidates):
            raise AssertionError("there is nothing to look at")

    loop_closer = closer(Reranks(), camera=views.camera, second_look=10)
    assert loop_closer.close(keyframe(0, views.reference), direction(0)) == ()


def test_a_second_look_is_not_taken_at_what_is_not_similar(views):
    loop_closer = closer(camera=views.camera, second_look=10)
    loop_closer.close(keyframe(0, views.reference), direction(90))
    (attempt,) = loop_closer.close(keyframe(1, views.query), direction(0))
    assert attempt.outcome.reason is RejectionReason.LOW_SIMILARITY


def test_in_a_large_map_known_places_are_no_candidates_any_more(views, monkeypatch):
    monkeypatch.setattr("slam.loops.candidates.novelty._ALL_KEPT", 6)
    loop_closer = closer(camera=views.camera, candidates=10)
    attempts = run(loop_closer, views, [0] * 9)
    assert [len(each) for each in attempts[:6]] == [0, 1, 2, 3, 4, 5]
    # From the third on, two others show all that each of them does.
    assert [pairs(each) for each in attempts[6:]] == [[(k, 0), (k, 1)] for k in (6, 7, 8)]
    assert loop_closer.similarities().shape == (9, 9)
    assert loop_closer.most_similar(direction(0)) == [0, 1]
    (only,) = loop_closer.close(keyframe(9, views.reference, 9.0), direction(90))
    assert only.rejection.reason is RejectionReason.LOW_SIMILARITY
    new = loop_closer.close(keyframe(10, views.reference, 10.0), direction(90))
    assert pairs(new) == [(10, 9)]


def test_where_the_recognizer_compares_every_place_stays_a_candidate(views, monkeypatch):
    monkeypatch.setattr("slam.loops.candidates.novelty._ALL_KEPT", 2)
    loop_closer = closer(Levels(), camera=views.camera, candidates=10)
    for number in range(4):
        new = keyframe(number, views.reference, 10.0 * number)
        attempts = loop_closer.close(new, np.zeros((1, 1), np.float32))
    assert pairs(attempts) == [(3, 0), (3, 1), (3, 2)]


def test_two_keyframes_of_any_maps_are_verified_as_those_of_a_run(views):
    match, query = keyframe(7, views.reference), keyframe(2, views.query, turning_rad_s=0.5)
    loop = verify_loop(match, query, views.camera)
    of_a_run = closer(camera=views.camera).verify(query, match, 0.9, Proposal.SIMILARITY)
    assert (loop.ref_id, loop.query_id) == (7, 2)
    np.testing.assert_array_equal(loop.motion.T_ref_query, of_a_run.outcome.T_ref_query)
    np.testing.assert_array_equal(loop.motion.information, of_a_run.outcome.information)
    np.testing.assert_allclose(loop.motion.T_ref_query, T_REF_QUERY, atol=1e-3)
    assert np.isfinite(loop.centre_ref_m).all()
    assert loop.radius_m > 0.0


def test_a_loop_that_is_not_verified_is_a_rejection(views, make_views):
    other = make_views(T_REF_QUERY, seed=5)
    refused = verify_loop(keyframe(0, views.reference), keyframe(0, other.query), views.camera)
    assert isinstance(refused, Rejection)
    strict = VerificationConfig(min_inliers=100_000)
    refused = verify_loop(
        keyframe(0, views.reference), keyframe(0, views.query), views.camera, strict
    )
    assert refused.reason is RejectionReason.FEW_INLIERS
