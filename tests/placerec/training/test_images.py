# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.training.images import Augmentation

NOTHING = {"brightness": 0.0, "blur": 0.0, "crop": 0.0, "perspective": 0.0, "roll_deg": 0.0}


def _image(height=60, width=80):
    coarse = np.random.default_rng(0).integers(0, 200, (6, 8, 3), np.uint8)
    return np.kron(coarse, np.ones((height // 6, width // 8, 1), np.uint8))


def _rng(seed=0):
    return np.random.default_rng(seed)


def test_nothing_asked_for_nothing_changed():
    np.testing.assert_array_equal(Augmentation(**NOTHING)(_image(), _rng()), _image())


@pytest.mark.parametrize(
    "change",
    [{"brightness": 0.4}, {"blur": 0.1}, {"crop": 0.3}, {"perspective": 0.1}, {"roll_deg": 20.0}],
)
def test_each_change_alone_is_seeded_and_leaves_the_image_alone(change):
    augmentation = Augmentation(**(NOTHING | change))
    image = _image()
    changed = [augmentation(image, _rng(seed)) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(image, _image())
    np.testing.assert_array_equal(changed[0], changed[1])
    assert (changed[0] != image).any()
    assert (changed[0] != changed[2]).any()
    assert changed[0].shape == image.shape
    assert changed[0].dtype == np.uint8


def test_roll_is_about_the_centre():
    image = np.zeros((61, 81, 3), np.uint8)
    image[28:33, 38:43] = 200
    for seed in range(5):
        rolled = Augmentation(**(NOTHING | {"roll_deg": 180.0}))(image, _rng(seed))
        rows, columns = np.nonzero(rolled[..., 0] > 100)
        assert abs(rows.mean() - 30) < 1.5
        assert abs(columns.mean() - 40) < 1.5


def test_crop_enlarges_what_is_left():
    image = np.zeros((60, 80, 3), np.uint8)
    image[20:40, 30:50] = 200
    areas = [
        (Augmentation(**(NOTHING | {"crop": 0.4}))(image, _rng(seed))[..., 0] > 100).sum()
        for seed in range(10)
    ]
    assert min(areas) >= 400
    assert max(areas) > 600


def test_blur_keeps_the_brightness():
    image = _image()
    blurred = Augmentation(**(NOTHING | {"blur": 0.1}))(image, _rng(1))
    assert blurred.mean() == pytest.approx(image.mean(), abs=2.0)
    assert (
        np.abs(np.diff(blurred.astype(int), axis=1)).max()
        < np.abs(np.diff(image.astype(int), axis=1)).max()
    )


def test_brightness_keeps_the_order_of_levels():
    ramp = np.repeat(np.arange(256, dtype=np.uint8)[None, :, None], 3, axis=2)
    lit = Augmentation(**(NOTHING | {"brightness": 0.5}))(ramp, _rng(3)).astype(int)
    assert (np.diff(lit, axis=1) >= 0).all()
    assert abs(lit.mean() - ramp.mean()) > 3
