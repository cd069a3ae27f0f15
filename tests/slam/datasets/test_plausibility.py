# SPDX-License-Identifier: Apache-2.0
import re
from dataclasses import replace

import numpy as np
import pytest

from slam.datasets.cameras import FREIBURG
from slam.datasets.plausibility import doubts_about_depth, doubts_about_intrinsics
from slam.types import Camera

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)


@pytest.mark.parametrize("camera", [CAMERA, *FREIBURG.values()])
def test_usual_cameras_raise_no_doubt(camera: Camera) -> None:
    assert doubts_about_intrinsics(camera) == []


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        (replace(CAMERA, fx=5250.0, fy=5250.0), "field of view of 7 degrees"),
        (replace(CAMERA, fx=52.5, fy=52.5), "field of view of 161 degrees"),
        (replace(CAMERA, fy=52.5), "fx = 525 and fy = 52.5"),
        (replace(CAMERA, cx=100.0), "principal point (100, 239.5)"),
        (replace(CAMERA, cy=470.0), "principal point (319.5, 470)"),
    ],
)
def test_intrinsics_that_can_hardly_be_right_are_named(camera: Camera, said: str) -> None:
    [doubt] = doubts_about_intrinsics(camera)
    assert said in doubt


def depth(median_m: float, missing: float = 0.0) -> list[np.ndarray]:
    values = np.full(1000, median_m, np.float32)
    values[: round(1000 * missing)] = 0.0
    return [values.reshape(25, 40)]


def test_usual_depth_raises_no_doubt() -> None:
    assert doubts_about_depth(depth(1.5, missing=0.85), 5000.0) == []
    assert doubts_about_depth([], 5000.0) == []


def test_a_scale_that_puts_everything_far_away_is_named_with_a_better_one() -> None:
    [doubt] = doubts_about_depth(depth(50.0), 100.0)
    assert "median depth of 1 sampled images is 50 m" in doubt
    assert "--input.depth-scale 5000 would make it 1 m" in doubt


def test_a_scale_that_puts_everything_too_near_is_named_with_a_better_one() -> None:
    [doubt] = doubts_about_depth(depth(0.1), 20000.0)
    assert "--input.depth-scale 1000 would make it 2 m" in doubt


@pytest.mark.parametrize("depth_scale", [5000.0, 1000.0, 1.0])
@pytest.mark.parametrize("median_m", [0.0002, 0.05, 7.0, 13.0, 50.0, 2000.0])
def test_no_scale_is_proposed_that_changes_nothing_or_is_absurd(
    median_m: float, depth_scale: float
) -> None:
    [doubt] = doubts_about_depth(depth(median_m), depth_scale)
    advised = re.search(r"--input.depth-scale (\d+) would make it ([\d.]+) m", doubt)
    if advised is None:
        assert "no usual depth scale" in doubt and "order of bytes" in doubt
        return
    scale, becomes_m = float(advised[1]), float(advised[2])
    assert scale != depth_scale and 0.4 <= becomes_m <= 4.5
    assert becomes_m == pytest.approx(median_m * depth_scale / scale, rel=0.01)


def test_depth_in_whole_metres_is_known() -> None:
    [doubt] = doubts_about_depth(depth(2.0 / 5000.0), 5000.0)
    assert "--input.depth-scale 1 would make it 2 m" in doubt


def test_mostly_missing_depth_is_named() -> None:
    [doubt] = doubts_about_depth(depth(1.5, missing=0.95), 5000.0)
    assert "95% of the depth pixels" in doubt
    [doubt] = doubts_about_depth(depth(1.5, missing=1.0), 5000.0)
    assert "100%" in doubt
