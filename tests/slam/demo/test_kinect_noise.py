# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.demo.kinect_noise import (
    DISPARITY_STEPS_M,
    add_colour_noise,
    add_kinect_noise,
    depth_bias,
    in_projector_shadow,
    is_grazing,
)
from slam.types import Camera

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)


def wall(depth_m):
    return np.full((480, 640), depth_m, np.float32)


def tilted_wall(angle_deg):
    """Depth of a plane turned about the upright axis, 2 m away along the optical axis."""
    x = (np.arange(640) - CAMERA.cx) / CAMERA.fx
    depth_m = 2.0 / (1.0 - np.tan(np.radians(angle_deg)) * x)
    return np.tile(np.where((depth_m > 0) & (depth_m < 20), depth_m, 0), (480, 1)).astype(
        np.float32
    )


def noisy(depth_m, seed=0):
    return add_kinect_noise(depth_m, CAMERA, np.random.default_rng(seed))


@pytest.mark.parametrize("depth_m", [1.0, 2.0, 3.0, 4.0])
def test_the_spread_is_what_the_papers_measured(depth_m):
    seen_m = noisy(wall(depth_m))
    assert seen_m.dtype == np.float32 and (seen_m > 0).mean() > 0.99
    error_m = (seen_m / (1.0 + depth_bias(CAMERA)) - depth_m)[seen_m > 0]
    axial_m = 0.0012 + 0.0019 * (depth_m - 0.4) ** 2
    quantisation_m = depth_m**2 / DISPARITY_STEPS_M / np.sqrt(12)
    assert error_m.std() == pytest.approx(np.hypot(axial_m, quantisation_m), rel=0.05)
    assert abs(error_m.mean()) < 0.1 * error_m.std()


def test_depth_comes_in_steps_of_disparity():
    seen_m = noisy(wall(3.0)).astype(float)
    steps = DISPARITY_STEPS_M / seen_m[seen_m > 0]
    assert np.abs(steps - np.rint(steps)).max() < 1e-3
    assert len(np.unique(seen_m)) < 30


def test_the_device_is_off_by_less_than_a_percent_smoothly_and_for_good():
    bias = depth_bias(CAMERA)
    assert bias.shape == (480, 640)
    assert -0.002 < bias.min() < 0.001 and 0.006 < bias.max() < 0.01
    assert max(np.abs(np.diff(bias, axis=axis)).max() for axis in (0, 1)) < 1e-4
    errors = [np.mean([noisy(wall(1.5), s)[:, :80] for s in seeds]) for seeds in ((1, 2), (3, 4))]
    assert errors[0] == pytest.approx(errors[1], abs=1e-4)


@pytest.mark.parametrize(("depth_m", "is_seen"), [(0.0, 0), (0.4, 0), (0.6, 1), (4.8, 1), (5.3, 0)])
def test_out_of_range_is_unknown(depth_m, is_seen):
    assert (noisy(wall(depth_m)) > 0).mean() == pytest.approx(is_seen, abs=0.02)


def test_something_near_keeps_the_light_from_the_wall_on_its_left():
    depth_m = wall(3.0)
    depth_m[:, 300:400] = 1.0
    shadow = in_projector_shadow(depth_m, CAMERA)
    # f b (1 / 1 m - 1 / 3 m) = 26.25 px
    assert shadow[:, 274:300].all()
    assert not shadow[:, :273].any() and not shadow[:, 300:].any()
    seen_m = noisy(depth_m)
    assert (seen_m[:, 275:299] == 0).all() and (seen_m[:, 402:] > 0).mean() > 0.99


def test_a_surface_seen_too_flat_sends_nothing_back():
    assert not is_grazing(tilted_wall(0), CAMERA).any()
    assert not is_grazing(tilted_wall(60), CAMERA)[5:-5, 200:350].any()
    # On the optical axis the angle of incidence is the tilt.
    assert not is_grazing(tilted_wall(77), CAMERA)[5:-5, 319].any()
    assert is_grazing(tilted_wall(83), CAMERA)[5:-5, 319].all()


def test_edges_are_ragged():
    depth_m = wall(2.0)
    depth_m[:, 320:] = 2.1  # a small step: some 1 px of shadow, and as much seen too flat
    is_hole = noisy(depth_m) == 0
    width_px = is_hole[:, 310:330].sum(axis=1)
    assert 1 <= np.median(width_px) <= 4
    assert len(np.unique(width_px)) > 2


def test_the_same_seed_gives_the_same_noise():
    assert np.array_equal(noisy(wall(2.0), 7), noisy(wall(2.0), 7))
    assert not np.array_equal(noisy(wall(2.0), 7), noisy(wall(2.0), 8))


def test_a_small_image_gets_the_same_sensor():
    small = Camera(160, 120, 131.25, 131.25, 79.5, 59.5)
    depth_m = np.full((120, 160), 2.0, np.float32)
    seen_m = add_kinect_noise(depth_m, small, np.random.default_rng(0))
    error_m = seen_m / (1.0 + depth_bias(small)) - depth_m
    whole_m = noisy(wall(2.0)) / (1.0 + depth_bias(CAMERA)) - 2.0
    assert error_m.std() == pytest.approx(whole_m.std(), rel=0.05)


def test_colour_is_grainy_and_dimmer_in_the_corners():
    grey = np.full((480, 640, 3), 150, np.uint8)
    seen = add_colour_noise(grey, np.random.default_rng(0)).astype(float)
    assert seen[230:250, 310:330].mean() == pytest.approx(150.0, abs=0.5)
    assert seen[:10, :10].mean() == pytest.approx(150 * 0.74, abs=2.0)
    assert seen[230:250, 310:330].std() == pytest.approx(2.0, rel=0.15)


def test_colour_noise_clips_instead_of_wrapping():
    for extreme in (0, 255):
        flat = np.full((48, 64, 3), extreme, np.uint8)
        seen = add_colour_noise(flat, np.random.default_rng(0)).astype(int)
        assert np.abs(seen[24, 32] - extreme).max() < 15
