# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from placerec.datasets.images import BrokenImage
from slam.datasets.phones.fitting import Fitting
from slam.types import Camera, SlamError

LARGE = Fitting(Camera(1920, 1440, 1500.0, 1500.0, 959.5, 719.5))
FILE = Path("7.png")


@pytest.mark.parametrize(
    ("size", "fitted"),
    [
        ((1920, 1440), (640, 480)),
        ((720, 960), (480, 640)),
        ((640, 480), (640, 480)),
        ((32, 24), (32, 24)),
    ],
)
def test_frames_have_no_side_longer_than_640(
    size: tuple[int, int], fitted: tuple[int, int]
) -> None:
    width, height = size
    camera = Fitting(Camera(width, height, width, width, width / 2, height / 2)).camera
    assert (camera.width, camera.height) == fitted
    assert camera.fx == pytest.approx(fitted[0])


def test_colour_is_the_mean_of_what_it_covers() -> None:
    rgb = np.zeros((1440, 1920, 3), np.uint8)
    rgb[30:33, 60:63] = 90
    rgb[31, 61] = 99
    fitted = LARGE.fit_color(rgb, FILE)
    assert not isinstance(fitted, BrokenImage)
    assert (fitted.shape, fitted[10, 20].tolist()) == ((480, 640, 3), [91, 91, 91])
    assert (fitted > 0).sum() == 3


def test_depth_is_that_of_the_nearest_pixel_and_never_a_mean() -> None:
    depth_m = np.zeros((96, 128), np.float32)
    depth_m[::2], depth_m[:, :50] = 1.0, 5.0
    fitted = LARGE.fit_depth(depth_m, FILE)
    assert not isinstance(fitted, BrokenImage)
    np.testing.assert_array_equal(fitted, depth_m.repeat(5, axis=0).repeat(5, axis=1))


def test_images_of_the_right_size_stay_as_they_are() -> None:
    fitting = Fitting(Camera(32, 24, 30.0, 30.0, 15.5, 11.5))
    rgb, depth_m = np.ones((24, 32, 3), np.uint8), np.ones((24, 32), np.float32)
    assert fitting.fit_color(rgb, FILE) is rgb
    np.testing.assert_array_equal(fitting.fit_depth(depth_m, FILE), depth_m)


def test_what_is_broken_stays_broken() -> None:
    broken = BrokenImage(FILE, "the file is cut off")
    assert LARGE.fit_color(broken, FILE) is broken
    assert LARGE.fit_depth(broken, FILE) is broken


def test_colour_of_another_size_and_depth_of_another_shape_are_refused() -> None:
    with pytest.raises(SlamError, match=r"has 640x480 pixels but the camera 1920x1440; .*7\.png"):
        LARGE.fit_color(np.zeros((480, 640, 3), np.uint8), FILE)
    with pytest.raises(SlamError, match=r"has 192x256 pixels, which is not the shape .*7\.png"):
        LARGE.fit_depth(np.zeros((256, 192), np.float32), FILE)
