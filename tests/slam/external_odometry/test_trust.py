# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.external_odometry.comparison import GivenKeyframe
from slam.external_odometry.trust import Verdict, judge
from slam.geometry import se3
from slam.types import Link, RelativePose

COUNT, STEP_S = 60, 1 / 3
STAMPS_S = dict(enumerate((np.arange(COUNT) * STEP_S).tolist()))
IMAGES_SIGMA = np.repeat([0.003, 0.005], 3)  # rad, m
NEIGHBOURS = [(a, b) for b in range(COUNT) for a in range(max(0, b - 5), b)]
LOOPS = [(a, a + 40) for a in range(20)]


@pytest.fixture(scope="module")
def truth(walk_at):
    return walk_at(np.array(list(STAMPS_S.values()))).T_world_cam


def motions(T_world_kf, noise=1.0, pairs=(*NEIGHBOURS, *LOOPS), seed=0):
    """Return what images measure, off by so many times the noise that they claim."""
    rng = np.random.default_rng(seed)
    information = np.diag(IMAGES_SIGMA**-2.0)
    errors = se3.exp(noise * IMAGES_SIGMA * rng.normal(size=(len(pairs), 6)))
    return [
        Link(a, b, RelativePose(se3.inverse(T_world_kf[a]) @ T_world_kf[b] @ error, information))
        for (a, b), error in zip(pairs, errors, strict=True)
    ]


def keyframes(T_given_kf):
    return {k: GivenKeyframe(T) for k, T in enumerate(T_given_kf)}


def led_astray(truth, errors):
    """Return the poses of an odometry whose steps end off by (N, 6) tangents, by keyframe id."""
    T = [truth[0]]
    for k in range(1, len(truth)):
        step = se3.inverse(truth[k - 1]) @ truth[k]
        T.append(T[-1] @ step @ se3.exp(np.asarray(errors[k])))
    return np.array(T)


def pushed(truth, ids, metres):
    errors = np.zeros((COUNT, 6))
    errors[ids, 3] = metres
    return led_astray(truth, errors)


def step_sigmas(trust):
    """Return (N, 6) standard deviations of the steps: rad and m."""
    return np.array(
        [np.sqrt(np.diag(np.linalg.inv(each.motion.information))) for each in trust.steps]
    )


@pytest.mark.parametrize("seed", range(3))
def test_the_truth_is_borne_out_and_followed(truth, seed):
    trust = judge(motions(truth, seed=seed), keyframes(truth), STAMPS_S)
    assert trust.verdict is Verdict.BORNE_OUT
    assert trust.is_followed
    assert (trust.doubted, trust.compared) == ((), len(NEIGHBOURS) + len(LOOPS))
    assert not trust.rotation_noise.any() and not trust.translation_noise.any()


def test_the_truth_is_hardly_ever_doubted_on_the_way(truth):
    """Of each keyframe all motions share the error, as those of one image do."""
    doubted = 0
    for seed in range(40):
        errors = IMAGES_SIGMA / np.sqrt(2.0) * np.random.default_rng(seed).normal(size=(COUNT, 6))
        seen = motions(truth @ se3.exp(errors), noise=0.0)
        verdicts = set()
        for count in range(10, COUNT + 1, 6):
            known = [each for each in seen if each.query_id < count]
            verdicts.add(judge(known, keyframes(truth[:count]), STAMPS_S).verdict)
        doubted += not verdicts <= {Verdict.UNKNOWN, Verdict.BORNE_OUT}
    assert doubted <= 2  # of 40


def test_what_is_borne_out_is_stiffer_than_anything_that_the_images_say(truth):
    trust = judge(motions(truth), keyframes(truth), STAMPS_S)
    assert [(each.ref_id, each.query_id) for each in trust.steps] == [
        (k, k + 1) for k in range(COUNT - 1)
    ]
    for each in trust.steps:
        expected = se3.inverse(truth[each.ref_id]) @ truth[each.query_id]
        np.testing.assert_allclose(each.motion.T_ref_query, expected, atol=1e-12)
    assert (step_sigmas(trust) < 0.01 * IMAGES_SIGMA).all()


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_what_agrees_more_closely_than_the_images_know_was_made_from_them(truth, noise):
    drifted = led_astray(truth, np.random.default_rng(1).normal(0.0, 0.02, (COUNT, 6)))
    trust = judge(motions(drifted, noise), keyframes(drifted), STAMPS_S)
    assert trust.verdict is Verdict.SHARED
    assert not trust.is_followed
    assert trust.steps == ()


@pytest.mark.parametrize("seed", range(4))
def test_noise_is_told_about_as_large_as_it_is(truth, seed):
    sigma = np.repeat([0.008, 0.015], 3)
    errors = sigma * np.random.default_rng(seed).normal(size=(COUNT, 6))
    trust = judge(motions(truth, seed=seed), keyframes(led_astray(truth, errors)), STAMPS_S)
    assert trust.verdict is Verdict.NOISY
    assert not trust.is_followed
    assert trust.doubted == ()
    step = se3.inverse(truth[:-1]) @ truth[1:]
    extent = np.array([se3.translation_norm(step).mean(), se3.rotation_angle(step).mean(), STEP_S])
    for told, expected in ((trust.rotation_noise, 0.008), (trust.translation_noise, 0.015)):
        assert (told >= 0.0).all()
        assert 0.6 < np.sqrt(told @ extent) / expected < 2.5


def test_steps_of_a_noisy_one_are_known_no_better_than_the_images_know(truth):
    errors = np.random.default_rng(0).normal(size=(COUNT, 6)) * np.repeat([0.008, 0.015], 3)
    trust = judge(motions(truth), keyframes(led_astray(truth, errors)), STAMPS_S)
    sigmas = step_sigmas(trust)
    assert len(sigmas) == COUNT - 1
    assert (sigmas >= IMAGES_SIGMA).all()
    off = np.abs(errors[1:]) / sigmas
    assert np.sqrt((off**2).mean()) < 1.5


def test_what_is_off_in_translation_alone_turns_no_better_than_the_images_know(truth):
    errors = np.random.default_rng(0).normal(size=(COUNT, 6)) * np.repeat([0.0, 0.03], 3)
    trust = judge(motions(truth), keyframes(led_astray(truth, errors)), STAMPS_S)
    sigmas = step_sigmas(trust)
    assert trust.verdict is Verdict.NOISY
    assert (sigmas[:, :3] > 0.9 * IMAGES_SIGMA[:3]).all() and (sigmas[:, :3] < 0.01).all()
    assert (sigmas[:, 3:] > 0.015).all()


def test_a_longer_step_of_a_noisy_one_is_known_less(truth):
    errors = np.random.default_rng(0).normal(size=(COUNT, 6)) * np.repeat([0.008, 0.015], 3)
    given = keyframes(led_astray(truth, errors))
    missing = range(20, 24)
    trust = judge(
        motions(truth), {k: each for k, each in given.items() if k not in missing}, STAMPS_S
    )
    steps = dict(zip([each.query_id for each in trust.steps], step_sigmas(trust), strict=True))
    assert (trust.steps[19].ref_id, trust.steps[19].query_id) == (19, 24)
    assert (steps[24] > 1.3 * steps[25]).all()
    assert not set(missing) & set(steps)


def test_what_grows_faster_than_noise_is_taken_for_as_large_as_it_gets(truth):
    too_long = truth.copy()
    too_long[:, :3, 3] *= 1.1
    trust = judge(motions(truth), keyframes(too_long), STAMPS_S)
    assert trust.verdict is Verdict.NOISY
    step = se3.inverse(truth[:-1]) @ truth[1:]
    ways_m, turns_rad = se3.translation_norm(step), se3.rotation_angle(step)
    gained = np.column_stack([ways_m, turns_rad, np.full(COUNT - 1, STEP_S)])
    variance = np.array([0.0, *np.cumsum(gained @ trust.translation_noise)])
    # Per axis, over as many keyframes as one is linked back.
    off_m = 0.1 * np.linalg.norm(truth[5:, :3, 3] - truth[:-5, :3, 3], axis=1) / np.sqrt(3.0)
    assert np.sqrt((off_m**2 / (variance[5:] - variance[:-5])).mean()) < 1.2


@pytest.mark.parametrize("metres", [0.05, 0.5, 20.0])
def test_a_leap_is_doubted_and_the_rest_borne_out(truth, metres):
    trust = judge(motions(truth), keyframes(pushed(truth, 30, metres)), STAMPS_S)
    assert trust.doubted == (30,)
    assert trust.verdict is Verdict.BORNE_OUT
    assert {each.query_id for each in trust.steps} == {*range(1, COUNT)} - {30}
    assert (step_sigmas(trust) < 0.01 * IMAGES_SIGMA).all()


def test_the_first_step_is_doubted_only_where_it_is_far_off(truth):
    # The first image is bent by a rolling shutter that nothing is known of yet.
    near, far = (
        judge(motions(truth, pairs=[(k, k + 1) for k in range(COUNT - 1)]), given, STAMPS_S)
        for given in (keyframes(pushed(truth, 1, each)) for each in (0.08, 0.5))
    )
    assert near.doubted == ()
    assert far.doubted == (1,)


def test_a_stretch_of_slow_slip_is_doubted(truth):
    slipping = range(20, 27)
    trust = judge(motions(truth), keyframes(pushed(truth, slipping, 0.02)), STAMPS_S)
    assert set(slipping) <= set(trust.doubted) <= set(range(18, 29))
    assert trust.verdict is Verdict.BORNE_OUT
    assert not set(trust.doubted) & {each.query_id for each in trust.steps}


def test_between_two_poses_is_known_only_about_where_the_camera_was(truth):
    """A steady motion is assumed, and very precise images see the difference."""
    sigmas = np.repeat([0.0001, 0.0002], 3)
    information, rng = np.diag(sigmas**-2.0), np.random.default_rng(0)
    measured = [
        Link(
            a,
            b,
            RelativePose(
                se3.inverse(truth[a]) @ truth[b] @ se3.exp(sigmas * rng.normal(size=6)), information
            ),
        )
        for a, b in (*NEIGHBOURS, *LOOPS)
    ]
    given = truth @ se3.exp(4e-4 * rng.normal(size=(COUNT, 6)))
    between = {k: replace(each, is_between=True) for k, each in keyframes(given).items()}
    trust = judge(measured, between, STAMPS_S)
    assert (trust.verdict, trust.doubted) == (Verdict.BORNE_OUT, ())


def test_a_bent_newest_image_casts_no_doubt_on_the_step_to_it(truth):
    """All motions over that are of its image."""
    T = truth.copy()
    T[-1] = T[-1] @ se3.exp(np.array([0.0, 0.0, 0.0, 0.03, 0.0, 0.0]))
    pairs = [(a, b) for b in range(COUNT) for a in range(max(0, b - 8), b)]
    trust = judge(motions(T, noise=0.3, pairs=pairs), keyframes(truth), STAMPS_S)
    assert trust.doubted == ()


def test_of_too_few_motions_nothing_is_known_and_a_fair_odometry_assumed(truth):
    for count in (0, 7):
        trust = judge(motions(truth)[:count], keyframes(truth), STAMPS_S)
        assert (trust.verdict, trust.compared) == (Verdict.UNKNOWN, count)
        assert len(trust.steps) == COUNT - 1
        sigmas = step_sigmas(trust)
        assert (sigmas[:, :3] > np.radians(0.05)).all() and (sigmas[:, :3] < np.radians(2.0)).all()
        assert (sigmas[:, 3:] > 0.001).all() and (sigmas[:, 3:] < 0.05).all()
    assert judge(motions(truth)[:20], keyframes(truth), STAMPS_S).verdict is not Verdict.UNKNOWN


def test_without_keyframes_there_are_no_steps(truth):
    trust = judge(motions(truth), {}, STAMPS_S)
    assert (trust.verdict, trust.steps, trust.compared) == (Verdict.UNKNOWN, (), 0)


def test_a_covariance_that_the_odometry_tells_is_believed(truth):
    told = np.diag([1e-4, 2e-4, 3e-4, 4e-4, 5e-4, 6e-4])
    given = keyframes(truth)
    given[7] = replace(given[7], covariance=told)
    steps = {each.query_id: each for each in judge(motions(truth), given, STAMPS_S).steps}
    np.testing.assert_allclose(np.linalg.inv(steps[7].motion.information), told, rtol=1e-9)
    assert np.linalg.inv(steps[8].motion.information).max() < 1e-9


def test_nothing_is_said_across_a_new_beginning(truth):
    elsewhere = se3.exp(np.array([0.5, -0.2, 1.0, 3.0, 2.0, -1.0]))
    given = keyframes(np.concatenate([truth[:25], elsewhere @ truth[25:]]))
    given[25] = replace(given[25], is_new=True)
    trust = judge(motions(truth), given, STAMPS_S)
    assert trust.verdict is Verdict.BORNE_OUT
    assert trust.doubted == ()
    assert {each.query_id for each in trust.steps} == {*range(1, COUNT)} - {25}
    across = sum(a < 25 <= b for a, b in (*NEIGHBOURS, *LOOPS))
    assert trust.compared == len(NEIGHBOURS) + len(LOOPS) - across


def test_a_motion_may_be_told_backwards(truth):
    turned = [
        Link(each.query_id, each.ref_id, replace(each.motion, T_ref_query=T))
        for each in motions(truth)
        for T in [se3.inverse(each.motion.T_ref_query)]
    ]
    assert judge(turned, keyframes(truth), STAMPS_S).verdict is Verdict.BORNE_OUT
    leapt = judge(turned, keyframes(pushed(truth, 30, 0.5)), STAMPS_S)
    assert leapt.doubted == (30,)


@pytest.mark.parametrize("rad", [0.02, 0.06])
def test_a_first_image_that_is_bent_casts_no_doubt_on_the_odometry(truth, rad):
    bend = se3.exp(np.array([rad, 0.0, 0.0, 0.0, 0.0, 0.0]))
    bent = [
        replace(each, motion=replace(each.motion, T_ref_query=bend @ each.motion.T_ref_query))
        if each.ref_id == 0
        else each
        for each in motions(truth)
    ]
    assert judge(bent, keyframes(truth), STAMPS_S).doubted == ()


def test_until_enough_is_compared_only_what_contradicts_is_held_against_it(truth):
    few = motions(truth, pairs=NEIGHBOURS[:6])
    fitting = judge(few, keyframes(truth[:5]), STAMPS_S)
    astray = judge(few, keyframes(pushed(truth, range(1, 5), 0.2)[:5]), STAMPS_S)
    assert (fitting.verdict, fitting.is_followed) == (Verdict.UNKNOWN, True)
    assert (astray.verdict, astray.is_followed) == (Verdict.NOISY, False)
