# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from slam.result import Calibration


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
