# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from benchmarks.training_scenes.rendered import TABLE_HEIGHT_M, cluttered_table, table_size
from slam.demo.room import assemble, render
from slam.types import Camera

CAMERA = Camera(96, 72, 80.0, 80.0, 47.5, 35.5)
LOOKING_DOWN = np.array([[0.0, -1, 0, 0], [-1, 0, 0, 0], [0, 0, -1, 2.0], [0, 0, 0, 1]])


@pytest.fixture(scope="module")
def panels():
    return cluttered_table(np.random.default_rng(3), 2.0, 1.2)


def _corners(panel):
    a, b = panel.right_m, panel.down_m
    return np.array([panel.corner_m + s * a + t * b for s in (0, 1) for t in (0, 1)])


def test_things_stand_on_the_table_and_not_beyond_its_reach(panels):
    above = [_corners(panel) for panel in panels]
    things = [
        c for c in above if c[:, 2].min() >= TABLE_HEIGHT_M - 1e-9 and np.abs(c[:, :2]).max() < 1.5
    ]
    assert len(things) > 100
    for corners in things:  # a thing as wide as a screen may stick out by half of it
        assert np.abs(corners[:, 1]).max() < 2.0 / 2 + 0.45
        assert np.abs(corners[:, 0]).max() < 1.2 / 2 + 0.45


def test_closed_room_with_a_table_in_its_middle(panels):
    frame = render(assemble(panels), CAMERA, LOOKING_DOWN)
    assert (frame.depth_m > 0).all()
    nearest = frame.depth_m[30:42, 40:56]
    assert (nearest <= 2.0 - TABLE_HEIGHT_M + 1e-5).all()
    assert frame.rgb.std() > 20


def test_same_seed_same_scene():
    def drawn(seed):
        return cluttered_table(np.random.default_rng(seed), 1.5, 1.0)

    first, second, other = drawn(1), drawn(1), drawn(2)
    assert len(first) == len(second)
    assert all((a.texture == b.texture).all() for a, b in zip(first, second, strict=True))
    assert len(other) != len(first) or (other[0].texture != first[0].texture).any()


def test_tables_are_of_many_sizes():
    sizes = np.array([table_size(np.random.default_rng(seed)) for seed in range(50)])
    assert (sizes.min(axis=0) > (1.4, 0.8)).all()
    assert (sizes.max(axis=0) < (3.2, 2.0)).all()
    assert (np.ptp(sizes, axis=0) > (1.2, 0.8)).all()
