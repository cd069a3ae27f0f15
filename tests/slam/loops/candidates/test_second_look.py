# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from placerec.checked_recognizer import CheckedRecognizer
from placerec.errors import RecognizerError
from placerec.recognizers.gradients import GradientRecognizer
from slam.config import Config, EvaluationConfig, FeaturesConfig, LoopConfig
from slam.evaluation.drift import compare_drift
from slam.geometry import se3
from slam.geometry.features import FeatureExtractor, grey_of
from slam.loops.candidates.second_look import NEEDED, SecondLook, rerank
from slam.output.summary import summarise
from slam.system import Slam
from slam.types import Frame, Keyframe, RejectionReason

T_REF_QUERY = se3.exp(np.array([0.05, -0.08, 0.03, 0.12, -0.05, 0.08]))


class Reranks(GradientRecognizer):
    """Has the last word on what is worth verifying, as it is told."""

    def __init__(self, answer):
        self.answer = answer

    def rerank(self, query, candidates):
        self.shapes = [query.shape, *(each.shape for each in candidates)]
        return self.answer


def keyframe(number, features):
    image = np.zeros((4, 6, 3), np.uint8)
    preview = Frame(float(number), image, np.zeros((4, 6), np.float32))
    return Keyframe(number, float(number), np.eye(4), features, preview)


def without_depth(features, share=1.0):
    depth_m = features.depth_m.copy()
    depth_m[: int(share * len(depth_m))] = np.nan
    return replace(features, depth_m=depth_m, points_m=features.points_m * depth_m[:, None])


@pytest.fixture
def views(make_views):
    return make_views(T_REF_QUERY, noise=0.5)


def test_a_true_pair_has_nearly_all_in_common_and_a_moved_about_one_next_to_nothing(
    views, make_views
):
    wrong = make_views(T_REF_QUERY, count=0, outliers=150)
    found = rerank(views.query, [views.reference], views.camera)
    assert found.dtype == np.int64 and found[0] > 75
    assert rerank(wrong.query, [wrong.reference], wrong.camera)[0] < NEEDED


def test_a_mirrored_scene_or_one_of_repeated_texture_is_no_true_pair(views):
    other = np.random.default_rng(1).permutation(len(views.query.descriptors))
    shuffled = replace(views.query, descriptors=views.query.descriptors[other])
    alike = replace(views.query, descriptors=np.zeros_like(views.query.descriptors))
    mirrored = replace(views.reference, points_m=views.reference.points_m * [1.0, 1.0, -1.0])
    found = rerank(views.reference, [views.query, shuffled, alike], views.camera)
    assert found[0] > 75 and max(found[1:]) < NEEDED
    # Distances do not tell a scene from its mirror image: that is left to verification.
    assert rerank(mirrored, [views.query], views.camera) == found[0]


def test_frames_of_one_place_have_more_in_common_than_others(frames, sequence, T_first_cam):
    extract = FeatureExtractor(sequence.camera, FeaturesConfig()).extract
    first, near, far = (extract(grey_of(frames[k].rgb), frames[k].depth_m) for k in (0, 59, 29))
    right, wrong = rerank(first, [near, far], sequence.camera)
    apart_m = np.linalg.norm(T_first_cam[[59, 29], :3, 3], axis=1)
    assert apart_m[0] < apart_m[1]
    assert right >= NEEDED and right > 3 * wrong
    np.testing.assert_array_equal(rerank(first, [far, near], sequence.camera), [wrong, right])


@pytest.mark.parametrize("count", [0, 1])
def test_what_shows_nothing_has_nothing_in_common(views, count):
    few = {name: values[:count] for name, values in vars(views.reference).items()}
    blank = replace(views.reference, **few)
    assert rerank(blank, [views.query, blank], views.camera).tolist() == [0, 0]
    assert rerank(views.query, [blank], views.camera).tolist() == [0]
    assert rerank(views.query, [without_depth(views.reference)], views.camera).tolist() == [0]


def looked_at(views, most, features, recognizer=None):
    recognizer = CheckedRecognizer(recognizer or GradientRecognizer())
    candidates = [keyframe(k, each) for k, each in enumerate(features)]
    return SecondLook(views.camera, recognizer, most).choose(keyframe(9, views.query), candidates)


def test_the_best_are_chosen_and_the_rest_says_what_it_needed(views, make_views):
    other = make_views(T_REF_QUERY, seed=5).reference
    half = replace(views.reference, descriptors=views.reference.descriptors.copy())
    half.descriptors[::2] ^= 255
    found = looked_at(views, 2, [other, half, views.reference, half])
    assert [(k, each.passed) for k, each in found] == [(2, True), (1, True), (3, False), (0, False)]
    *chosen, equal, worst = (each for _, each in found)
    assert chosen[0].measured > chosen[1].measured == chosen[1].needed
    assert equal.reason is RejectionReason.SECOND_LOOK
    assert equal.measured == equal.needed > worst.measured
    ((_, alone),) = looked_at(views, 2, [other])
    assert (alone.measured, alone.needed) == (0.0, NEEDED)


def test_nobody_is_refused_for_want_of_depth(views):
    for poor in (without_depth(views.reference, 0.9), without_depth(views.reference)):
        ((_, check),) = looked_at(views, 2, [poor])
        assert check.passed


def test_a_recognizer_that_looks_again_by_itself_is_asked_for_previews(views):
    recognizer = Reranks([0.2, 0.0, 0.7])
    chosen = looked_at(views, 2, [views.reference] * 3, recognizer)
    assert [k for k, _ in chosen] == [2, 0, 1]
    assert [check.passed for _, check in chosen] == [True, True, False]
    assert recognizer.shapes == [(4, 6, 3)] * 4


def test_a_rerank_that_misbehaves_is_one_line(views):
    with pytest.raises(RecognizerError, match="a score of nan; it must lie from 0 to 1"):
        looked_at(views, 2, [views.reference] * 2, Reranks([0.5, np.nan]))


def test_it_loses_no_loop_of_a_short_recording(frames, room_run, sequence):
    looking = Slam(sequence.camera, GradientRecognizer(), Config(loop=LoopConfig(second_look=10)))
    for frame in frames:
        looking.process(frame)
    summaries = [
        summarise(result, compare_drift(result, sequence.ground_truth, EvaluationConfig()))
        for result in (room_run, looking.finish())
    ]
    for name in ("loops_accepted", "keyframes_with_loop"):
        assert summaries[1][name] >= summaries[0][name] > 0
    verified, now = (each["loops_verified"] for each in summaries)
    assert now <= verified
    errors_m = [each["ate_corrected_m"] for each in summaries]
    assert errors_m[1] <= max(1.02 * errors_m[0], errors_m[0] + 2e-4)
    assert summaries[1]["loops_false"] == 0
