# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np
import pytest

from placerec.certificate import Certificate
from slam.calibration import Calibration

CERTIFICATE = Certificate(
    recognizer="tower.safetensors",
    fingerprint="sha256:0",
    data="ie_tower:validation",
    images=10,
    skipped=1,
    pairs=45,
    same_place_pairs=9,
    threshold=0.8,
    highest_wrong=0.75,
    recall=0.5,
    threshold_interval=(0.7, 0.85),
    recall_interval=(0.25, 0.75),
    resampled="places",
    resamples=100,
    without_threshold=2,
    seed=0,
    different_places=(-0.1, 0.6),
    same_place=(0.3, 0.9),
    recall_to_verify=0.75,
    curve=((0.8, 1.0, 0.5),),
)


def calibration(*similarities):
    return Calibration(CERTIFICATE, np.array(similarities, np.float32))


def test_shares_of_what_was_met():
    met = calibration(-0.2, 0.0, 0.5, 0.6, 0.95)
    assert met.passing == pytest.approx(2 / 5)
    assert met.outside == pytest.approx(2 / 5)


def test_what_is_unlike_the_calibration_is_warned_of():
    assert calibration(*np.linspace(-0.1, 0.9, 100)).warnings == ()
    (warning,) = calibration(*[-0.5] * 100).warnings
    assert "100% of the 100 similarities lie outside" in warning


def test_without_pairs_nothing_is_known():
    assert calibration().warnings == ()
    assert math.isnan(calibration().passing) and math.isnan(calibration().outside)
