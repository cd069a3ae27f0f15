# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from slam.result import Calibration, compared


@pytest.fixture
def calibration(certificate):
    def met(*similarities):
        return Calibration(certificate, np.array(similarities, np.float32))

    return met


def test_shares_of_what_was_met(calibration):
    met = calibration(-0.2, 0.0, 0.5, 0.6, 0.95)
    assert met.passing == pytest.approx(2 / 5)
    assert met.outside == pytest.approx(2 / 5)


def test_what_is_unlike_the_calibration_is_warned_of(calibration):
    assert calibration(*np.linspace(-0.1, 0.9, 100)).warnings == ()
    (warning,) = calibration(*[-0.5] * 100).warnings
    assert "100% of the 100 similarities lie outside" in warning


def test_without_pairs_nothing_is_known(calibration):
    assert calibration().warnings == ()
    assert math.isnan(calibration().passing) and math.isnan(calibration().outside)


@pytest.mark.parametrize(
    ("count", "step"), [(0, 1), (1, 1), (400, 1), (401, 2), (800, 2), (801, 4), (10_000, 32)]
)
def test_so_many_keyframes_are_compared_as_a_picture_can_show(count, step):
    shown = compared(count)
    assert shown == range(0, count, step) and len(shown) <= 400
