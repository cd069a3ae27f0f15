# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.geometry.motion_noise import (
    link_noise,
    loop_noise,
    translation_sigma_m,
    typical_depth_m,
)
from slam.types import Camera, RelativePose

GLOBAL = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
ROLLING = replace(GLOBAL, readout_s=0.02)
SHARP = RelativePose(np.eye(4), np.diag([1e8] * 3 + [1e8] * 3))


def sigmas(motion):
    return np.sqrt(np.diag(np.linalg.inv(motion.information)))


@pytest.mark.parametrize("noise", [loop_noise, link_noise])
def test_turning_costs_a_global_shutter_nothing_and_a_rolling_one_more_and_more(noise):
    still, fast = (noise(SHARP, GLOBAL, 1.0, turning, 0.0) for turning in (0.0, 10.0))
    np.testing.assert_array_equal(still.information, fast.information)
    bent = [noise(SHARP, ROLLING, 1.0, turning, 0.0) for turning in (0.0, 1.0, 3.0)]
    for vaguer, sharper in zip(bent[1:] + bent[:1], [*bent[:-1], still], strict=True):
        assert (np.linalg.eigvalsh(sharper.information - vaguer.information) > 0.0).all()


@pytest.mark.parametrize("noise", [loop_noise, link_noise])
def test_the_two_cameras_turnings_add_up_and_their_order_is_the_same(noise):
    np.testing.assert_allclose(
        noise(SHARP, ROLLING, 1.0, 3.0, 4.0).information,
        noise(SHARP, ROLLING, 1.0, 5.0).information,
    )


def test_what_bends_the_image_shifts_the_camera_in_proportion_to_the_depth():
    near, far = (sigmas(loop_noise(SHARP, ROLLING, depth_m, 2.0)) for depth_m in (1.0, 4.0))
    np.testing.assert_allclose(near[:3], far[:3])
    np.testing.assert_allclose(4.0 * near[3:], far[3:], rtol=1e-2)
    np.testing.assert_allclose(near[3:], near[:3])


def test_what_the_matches_do_not_know_stays_unknown():
    vague = RelativePose(np.eye(4), np.diag([1e8, 1e8, 1e8, 1e8, 1e8, 1.0]))
    noisy = loop_noise(vague, ROLLING, 1.0, 1.0)
    assert sigmas(noisy)[5] == pytest.approx(1.0, rel=1e-3)
    np.testing.assert_array_equal(noisy.information, noisy.information.T)
    np.testing.assert_array_equal(noisy.T_ref_query, vague.T_ref_query)


def test_the_translation_sigma_takes_all_directions_together():
    covariance = np.diag([1.0, 1.0, 1.0, 0.01**2, 0.02**2, 0.02**2])
    motion = RelativePose(np.eye(4), np.linalg.inv(covariance))
    assert translation_sigma_m(motion) == pytest.approx(0.03)


def test_the_typical_depth_is_the_median_of_what_is_known(make_views):
    views = make_views(np.eye(4))
    blind = replace(views.query, depth_m=np.full(len(views.query.depth_m), np.nan))
    assert typical_depth_m(views.reference, blind) == np.nanmedian(views.reference.depth_m)
    assert typical_depth_m(blind) == 1.0
