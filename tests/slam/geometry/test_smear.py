# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from slam.geometry.features import grey_of
from slam.geometry.smear import sharpness


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, 90.0])
def test_a_smear_in_any_direction_takes_away_sharpness(frames, angle_deg):
    kernel = np.zeros((17, 17), np.float32)
    ends = 8.0 * np.array([np.cos(np.radians(angle_deg)), np.sin(np.radians(angle_deg))])
    from_px, to_px = (tuple(np.rint(8.0 + sign * ends).astype(int).tolist()) for sign in (-1, 1))
    cv2.line(kernel, from_px, to_px, 1.0)
    for frame in frames[::15]:
        grey = grey_of(frame.rgb)
        smeared = cv2.filter2D(grey, -1, kernel / kernel.sum())
        assert sharpness(smeared) < 0.6 * sharpness(grey)


def test_less_contrast_or_light_is_no_smear(frames):
    for frame in frames[::15]:
        grey = grey_of(frame.rgb)
        dim = (0.4 * grey.astype(np.float32) + 10.0).astype(np.uint8)
        assert sharpness(dim) > 0.8 * sharpness(grey)


def test_in_a_blank_image_there_is_nothing_to_be_smeared():
    assert sharpness(np.full((48, 64), 90, np.uint8)) == np.inf
