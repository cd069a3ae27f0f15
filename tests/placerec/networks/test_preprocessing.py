# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.errors import RecognizerError
from placerec.networks import Preprocessing

RGB = Preprocessing(8, 6, (10.0, 20.0, 30.0), (1.0, 2.0, 5.0))


def _plain(*shape, colour=(110, 120, 130)):
    return np.full((*shape, len(colour)), colour, np.uint8)


def test_mean_and_scale_are_per_channel():
    values = RGB(_plain(6, 8))
    assert values.shape == (3, 6, 8)
    assert values.dtype == np.float32
    assert values[:, 0, 0].tolist() == [100.0, 50.0, 20.0]


def test_blue_first_where_the_network_wants_it():
    values = Preprocessing(8, 6, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), is_bgr=True)(_plain(6, 8))
    assert values[:, 0, 0].tolist() == [130.0, 120.0, 110.0]


@pytest.mark.parametrize("shape", [(480, 640), (1, 1), (3, 200), (6, 8), (200, 3)])
def test_any_size(shape):
    values = RGB(_plain(*shape))
    assert values.shape == (3, 6, 8)
    np.testing.assert_allclose(values[0], np.full((6, 8), 100.0), rtol=1e-6)


def test_grey_and_alpha():
    grey = RGB(np.full((9, 9), 130, np.uint8))
    assert np.array_equal(grey, RGB(np.full((9, 9, 1), 130, np.uint8)))
    assert np.array_equal(grey, RGB(_plain(9, 9, colour=(130, 130, 130))))
    assert np.array_equal(grey, RGB(_plain(9, 9, colour=(130, 130, 130, 7))))


def test_shrinking_averages():
    stripes = np.zeros((60, 80, 3), np.uint8)
    stripes[:, ::2] = 200
    values = Preprocessing(8, 6, (0.0, 0.0, 0.0), (1.0, 1.0, 1.0))(stripes)
    np.testing.assert_allclose(values, np.full((3, 6, 8), 100.0), rtol=1e-6)


def test_image_is_left_alone_and_may_be_a_view():
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    before = image.copy()
    view = RGB(image[::-1, ::2, ::-1])
    assert np.array_equal(view, RGB(np.ascontiguousarray(image[::-1, ::2, ::-1])))
    np.testing.assert_array_equal(image, before)


@pytest.mark.parametrize(
    ("image", "message"),
    [
        (np.zeros((4, 4, 3)), "uint8 array, not float64"),
        ([[0]], "uint8 array, not list"),
        (np.zeros((4, 4, 2), np.uint8), r"shape \(4, 4, 2\)"),
        (np.zeros((0, 4, 3), np.uint8), r"shape \(0, 4, 3\)"),
        (np.zeros(4, np.uint8), r"shape \(4,\)"),
    ],
)
def test_what_is_no_image(image, message):
    with pytest.raises(RecognizerError, match=message):
        RGB(image)
