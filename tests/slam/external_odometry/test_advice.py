# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.config import OdometryConfig
from slam.external_odometry.advice import asked_convention, judgement, read
from slam.external_odometry.calibration import Calibration
from slam.external_odometry.conventions import Convention
from slam.external_odometry.hand_eye import HandEye
from slam.external_odometry.trust import Trust, Verdict
from slam.geometry import se3

CAMERA = OdometryConfig()
AUTO = OdometryConfig(T_base_cam="auto", scale="auto", time_offset_s="auto")
BODY = se3.from_rotation_translation(
    se3.from_quaternion(np.array([-0.5, 0.5, -0.5, 0.5])), np.array([0.2, 0.0, 0.3])
)
BODY_FLAG = "--odometry.T-base-cam 0.2000 0.0000 0.3000 -0.5000 0.5000 -0.5000 0.5000"


def found(
    misfit=0.02, before=0.8, of_motions=(0.0, 1.0), sigmas=(0.002, 0.004, 0.001), **convention
):
    """Return what calibration found; of the motions, the share unexplained and the likeness."""
    reading = Convention(**convention)
    hand_eye = HandEye(reading.T_base_cam, reading.scale, misfit, *of_motions, *sigmas)
    return Calibration(reading, hand_eye, before)


def is_same(one, other):
    return (one.scale, one.time_offset_s, one.is_inverted, one.is_w_first) == (
        other.scale,
        other.time_offset_s,
        other.is_inverted,
        other.is_w_first,
    ) and np.array_equal(one.T_base_cam, other.T_base_cam)


def turned(degrees):
    return se3.exp(np.array([np.radians(degrees), 0.0, 0.0, 0.0, 0.0, 0.0]))


def moved(metres):
    return se3.exp(np.array([0.0, 0.0, 0.0, metres, 0.0, 0.0]))


def test_settings_say_how_poses_are_to_be_read():
    config = OdometryConfig(
        T_base_cam=(0.2, 0.0, 0.3, -1.0, 1.0, -1.0, 1.0),
        scale=0.5,
        time_offset_s=-0.1,
        inverted=True,
        w_first=True,
    )
    convention = asked_convention(config)
    np.testing.assert_allclose(convention.T_base_cam, BODY, atol=1e-12)
    assert (convention.scale, convention.time_offset_s) == (0.5, -0.1)
    assert convention.is_inverted and convention.is_w_first
    for config in (CAMERA, AUTO):
        assert is_same(asked_convention(config), Convention())


def eye(T=None, scale=1.0, misfit=0.03, scale_sigma=0.01):
    return HandEye(np.eye(4) if T is None else T, scale, misfit, 0.0, 1.0, 0.002, 0.01, scale_sigma)


@pytest.mark.parametrize(
    ("T", "apart"),
    [(turned(30.0), "turned by 30 deg and 0 cm"), (moved(0.4), "turned by 0 deg and 40 cm")],
    ids=["turned", "moved"],
)
def test_poses_of_two_bodies_are_refused_and_told_how_far_apart_they_are(T, apart):
    mixed = replace(found(0.2, 0.2, (0.1, 0.6)), sides=(eye(), eye(T)), misfit_of_sides=0.6)
    reading = read(AUTO, mixed)
    assert not reading.fits
    (said,) = reading.sentences
    assert f"two frames mixed, {apart} apart" in said


@pytest.mark.parametrize(
    ("sides", "as_one"),
    [
        ((eye(), eye(turned(30.0))), 0.25),
        ((eye(), eye(turned(30.0), misfit=0.4)), 0.6),
        ((), 0.0),
    ],
    ids=["one frame does for both", "a side that fits nowhere", "too short"],
)
def test_sides_that_prove_nothing_are_not_held_against_poses(sides, as_one):
    of_sides = replace(found(0.2, 0.2, (0.1, 0.6)), sides=sides, misfit_of_sides=as_one)
    assert read(AUTO, of_sides).fits


@pytest.mark.parametrize(
    ("last", "sigma", "is_said"),
    [(0.9, 0.01, True), (1.1, 0.01, True), (1.02, 0.001, False), (0.9, 0.05, False)],
)
@pytest.mark.parametrize("before", [0.02, 0.8])
def test_a_scale_that_drifts_is_told(last, sigma, is_said, before):
    ends = (eye(scale_sigma=sigma), eye(scale=last, scale_sigma=sigma))
    said = read(CAMERA, replace(found(before=before), ends=ends)).sentences
    assert any("scale drifts" in each and f"by {last:.3f} in" in each for each in said) is is_said


@pytest.mark.parametrize(
    ("convention", "flag", "others"),
    [
        (
            {"T_base_cam": BODY},
            BODY_FLAG,
            "another frame than the camera's optical one; known to 0.1 deg and 0.4 cm",
        ),
        ({"time_offset_s": 0.15}, "--odometry.time-offset-s 0.150", "150 ms later"),
        ({"time_offset_s": -0.3}, "--odometry.time-offset-s -0.300", "300 ms earlier"),
        ({"scale": 1.25}, "--odometry.scale 1.2500", "20.0% too short; known to 0.1%"),
        ({"scale": 0.8}, "--odometry.scale 0.8000", "25.0% too long"),
        ({"scale": 0.3048}, "--odometry.scale 0.3048", "(feet)"),
        ({"is_inverted": True}, "--odometry.inverted True", "take the world to the camera"),
        ({"is_w_first": True}, "--odometry.w-first True", "are w x y z"),
    ],
    ids=["frame", "late", "early", "short", "long", "feet", "inverted", "w first"],
)
def test_what_is_off_is_one_sentence_with_the_flag_to_use_and_applied_where_it_is_auto(
    convention, flag, others
):
    told, done = (read(config, found(**convention)) for config in (CAMERA, AUTO))
    for reading in (told, done):
        (sentence,) = reading.sentences
        assert flag in sentence
        assert all(part in sentence for part in others.split("; "))
        assert reading.fits
    assert is_same(told.convention, Convention())
    assert "or auto" in told.sentences[0] or "T-base-cam auto" in told.sentences[0]
    assert is_same(done.convention, Convention(**convention))
    assert "it was applied" in done.sentences[0]


def test_only_what_is_auto_is_applied():
    everything = found(T_base_cam=BODY, scale=1.25, time_offset_s=0.15, is_inverted=True)
    for config, expected in (
        (CAMERA, Convention()),
        (OdometryConfig(scale="auto"), Convention(scale=1.25)),
        (OdometryConfig(time_offset_s="auto"), Convention(time_offset_s=0.15)),
        (OdometryConfig(T_base_cam="auto"), Convention(BODY, is_inverted=True)),
        (AUTO, everything.convention),
    ):
        reading = read(config, everything)
        assert is_same(reading.convention, expected)
        assert len(reading.sentences) == 4
        applied = sum("it was applied" in each for each in reading.sentences)
        autos = [config.T_base_cam, config.T_base_cam, config.scale, config.time_offset_s]
        assert applied == autos.count("auto")  # frame and direction go by the same flag


def test_a_flag_that_should_not_have_been_given_is_taken_back():
    config = OdometryConfig(inverted=True, w_first=True)
    inverted, w_first = read(config, found()).sentences
    assert "take the camera to the world: --odometry.inverted False" in inverted
    assert "quaternions are x y z w: --odometry.w-first False" in w_first


def test_where_nothing_is_off_nothing_is_said():
    for config in (CAMERA, AUTO):
        reading = read(config, found(before=0.02))
        assert (reading.sentences, reading.fits) == ((), True)
        assert is_same(reading.convention, Convention())
    asked = OdometryConfig(scale=1.25, time_offset_s=0.15, inverted=True)
    right = found(scale=1.25, time_offset_s=0.15, is_inverted=True)
    assert read(asked, right).sentences == ()


@pytest.mark.parametrize(
    ("convention", "is_said"),
    [
        ({"T_base_cam": turned(1.9)}, False),
        ({"T_base_cam": turned(2.1)}, True),
        ({"T_base_cam": moved(0.029)}, False),
        ({"T_base_cam": moved(0.031)}, True),
        ({"time_offset_s": 0.019}, False),
        ({"time_offset_s": -0.021}, True),
        ({"scale": 1.009}, False),
        ({"scale": 1.011}, True),
    ],
)
def test_what_is_small_is_not_worth_a_word(convention, is_said):
    for config in (CAMERA, AUTO):
        reading = read(config, found(**convention))
        assert len(reading.sentences) == is_said
    expected = Convention(**convention) if is_said else Convention()
    assert is_same(reading.convention, expected)


@pytest.mark.parametrize(
    ("convention", "sigmas"),
    [
        ({"T_base_cam": turned(3.0)}, (np.radians(0.8), 0.0, 0.0)),
        ({"T_base_cam": moved(0.1)}, (0.0, 0.03, 0.0)),
        ({"scale": 1.05}, (0.0, 0.0, 0.015)),
    ],
)
def test_what_may_be_chance_is_not_said(convention, sigmas):
    assert read(AUTO, found(sigmas=sigmas, **convention)).sentences == ()
    better = tuple(0.5 * each for each in sigmas)
    assert len(read(AUTO, found(sigmas=better, **convention)).sentences) == 1


def test_where_too_little_is_known_poses_are_read_as_was_asked_for():
    config = OdometryConfig(scale=2.0, time_offset_s="auto")
    reading = read(config, None)
    assert is_same(reading.convention, Convention(scale=2.0))
    assert (reading.sentences, reading.fits) == ((), True)


def test_a_reading_that_hardly_fits_better_is_not_taken():
    other = {"scale": 1.25, "time_offset_s": 0.15}
    vague = read(AUTO, found(misfit=0.4, before=0.9, **other))
    no_better = read(AUTO, found(misfit=0.19, before=0.2, **other))
    of_two = read(AUTO, found(misfit=0.2, before=0.5, of_motions=(0.0, 0.8), **other))
    for reading in (vague, no_better, of_two):
        assert is_same(reading.convention, Convention())
        assert (reading.sentences, reading.fits) == ((), True)


def test_poses_that_are_only_noisy_are_those_of_the_images():
    reading = read(AUTO, found(misfit=1.1, before=1.2, of_motions=(0.9, 0.8), scale=0.5))
    assert (reading.sentences, reading.fits) == ((), True)


@pytest.mark.parametrize(
    "measured",
    [
        {"misfit": 0.99, "before": 1.2, "of_motions": (0.9, 0.1)},
        {"misfit": 0.1, "before": 0.1, "of_motions": (0.4, 1.0)},
    ],
    ids=["of another recording", "of two frames"],
)
def test_poses_that_have_nothing_to_do_with_the_images_are_not_used(measured):
    reading = read(AUTO, found(scale=1.25, **measured))
    assert not reading.fits
    (sentence,) = reading.sentences
    assert "do not fit the images" in sentence and "not used" in sentence
    assert is_same(reading.convention, Convention())


def trusted(verdict, doubted=(), rotation=(0.0, 0.0, 0.0), translation=(0.0, 0.0, 0.0)):
    return Trust(verdict, np.array(rotation), np.array(translation), doubted, (), 123)


STAMPS_S = {k: 10.0 + 0.5 * k for k in range(40)}


@pytest.mark.parametrize("verdict", Verdict)
def test_the_verdict_says_what_it_rests_on(verdict):
    sentence, doubts = judgement(trusted(verdict), STAMPS_S)
    assert verdict in sentence and "123 motions" in sentence
    assert ("noise" in sentence.replace(verdict, "")) is (verdict is Verdict.NOISY)
    assert doubts == ()


def test_noise_is_told_in_degrees_and_centimetres():
    noise = trusted(Verdict.NOISY, (), (np.radians(2.0) ** 2, 0.0, 0.0), (0.03**2, 0.0, 0.004**2))
    sentence, _ = judgement(noise, STAMPS_S)
    assert "2 deg and 3 cm in a metre" in sentence
    assert "0 deg and 0.4 cm in a second" in sentence
    assert "in a radian" not in sentence
    nothing, _ = judgement(trusted(Verdict.NOISY), STAMPS_S)
    assert "less than can be told" in nothing


@pytest.mark.parametrize(
    ("doubted", "expected"),
    [
        ((4,), "from 11.50 to 12.00 s;"),
        ((4, 5, 6), "from 11.50 to 13.00 s;"),
        ((4, 6), "from 11.50 to 12.00 s, 12.50 to 13.00 s;"),
        ((4, 10, 20), "from 11.50 to 12.00 s, 14.50 to 15.00 s, 19.50 to 20.00 s;"),
        (
            (4, 10, 20, 30, 31, 38),
            "from 11.50 to 12.00 s, 14.50 to 15.00 s, 19.50 to 20.00 s and 2 more stretches;",
        ),
    ],
)
def test_where_the_images_contradict_it_is_told_in_seconds(doubted, expected):
    _, (sentence,) = judgement(trusted(Verdict.BORNE_OUT, doubted), STAMPS_S)
    assert "contradict the odometry" in sentence
    assert expected in sentence
