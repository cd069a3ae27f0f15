# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.geometry import se3
from slam.mapping.view_overlap import ViewOverlap
from slam.types import Camera, Features

CAMERA = Camera(320, 240, 200.0, 200.0, 159.5, 119.5)
HALF = np.arctan(160.0 / 200.0)  # of the field of view, rad
WALL_M = 2.0


def wall():
    """Return the features of a camera that looks straight at a wall 2 m away."""
    u, v = (each.ravel() for each in np.meshgrid(np.arange(5, 320, 10.0), np.arange(5, 240, 10.0)))
    pixels = np.stack([u, v], axis=1).astype(np.float32)
    points_m = np.stack(
        [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones_like(u)], axis=1
    )
    points_m = (WALL_M * points_m).astype(np.float32)
    count = len(u)
    octaves, descriptors = np.zeros(count, np.uint8), np.zeros((count, 32), np.uint8)
    return Features(pixels, pixels, octaves, descriptors, points_m[:, 2], points_m)


def overlap(T_first_second, off_m=0.0, view=None):
    """Return that of two cameras, the second off by so much to either side."""
    T = np.stack([np.eye(4), T_first_second])
    off = np.zeros((2, 6, 2))
    off[1, 3:] = off_m * np.array([-1.0, 1.0])
    views = [wall(), wall() if view is None else view]
    return ViewOverlap(views, T, off, CAMERA).of(1, np.array([0]))[0]


def moved(x=0.0, z=0.0, turned=0.0):
    return se3.exp(np.array([0.0, 0.0, 0.0, x, 0.0, z])) @ se3.exp(
        np.array([0.0, turned, 0.0, 0.0, 0.0, 0.0])
    )


def test_the_same_view_overlaps_wholly_and_one_beside_it_not_at_all():
    assert overlap(np.eye(4)) > 0.95
    width_m = 2.0 * WALL_M * np.tan(HALF)
    assert overlap(moved(x=0.5 * width_m)) == pytest.approx(0.5, abs=0.05)
    assert overlap(moved(x=1.1 * width_m)) < 0.02


@pytest.mark.parametrize(
    "T",
    [
        moved(z=2 * WALL_M, turned=np.pi),  # the wall from behind
        moved(z=-3.0 * WALL_M),  # all of it, from four times as far
        moved(turned=np.pi),
        np.full((4, 4), np.nan),
    ],
    ids=["from behind", "from afar", "away", "nowhere"],
)
def test_what_would_not_look_alike_does_not_overlap(T):
    assert overlap(T) == 0.0


def test_a_view_without_points_overlaps_with_none():
    assert overlap(np.eye(4), view=Features.none()) == 0.0


def test_the_less_is_known_of_a_pose_the_less_is_said_by_it():
    beside = moved(x=2.2 * WALL_M * np.tan(HALF))
    assert overlap(np.eye(4), off_m=1.0) < 0.9
    assert overlap(beside, off_m=1.0) > 10.0 * overlap(beside)
