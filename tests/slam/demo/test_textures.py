# SPDX-License-Identifier: Apache-2.0
from functools import partial

import numpy as np
import pytest

from slam.demo import textures, wall_pictures

COLOUR = (180.0, 150.0, 120.0)
PAINTED = ("plaster", "bricks", "planks", "panelling", "wood", "wallpaper", "cloth")
DRAWN = ("landscape", "abstract", "contours", "page", "framed", "window", "screen", "spine")
MATERIALS = {
    **{name: partial(getattr(textures, name), colour=COLOUR) for name in PAINTED},
    **{name: getattr(wall_pictures, name) for name in DRAWN},
}


@pytest.mark.parametrize("name", MATERIALS)
@pytest.mark.parametrize(("width_m", "height_m"), [(0.7, 0.5), (0.03, 0.4), (0.002, 0.01)])
def test_a_material_fills_any_size_the_same_way_each_time(name, width_m, height_m):
    images = [MATERIALS[name](np.random.default_rng(5), width_m, height_m) for _ in range(2)]
    width, height = textures.size_px(width_m, height_m)
    assert images[0].shape == (height, width, 3) and images[0].dtype == np.uint8
    assert np.array_equal(images[0], images[1])


@pytest.mark.parametrize("name", MATERIALS)
def test_a_material_has_texture_and_never_looks_the_same_twice(name):
    rng = np.random.default_rng(5)
    first, second = (MATERIALS[name](rng, 0.5, 0.5).astype(float) for _ in range(2))
    assert first.std(axis=(0, 1)).max() > 4.0
    assert np.abs(first - second).mean() > 4.0


def test_noise_is_as_smooth_as_its_cells():
    rng = np.random.default_rng(0)
    coarse, fine = (textures.noise(rng, (200, 150), (cell, cell), 1) for cell in (40, 4))
    assert coarse.shape == (150, 200)
    assert abs(float(fine.mean())) < 0.1 and 0.5 < float(fine.std()) < 1.2
    assert np.abs(np.diff(coarse)).mean() < 0.2 * np.abs(np.diff(fine)).mean()
