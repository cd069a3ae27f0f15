# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from slam.datasets.bags.camera_info import camera_of_info
from slam.datasets.cameras import FREIBURG
from slam.types import SlamError

PATH = Path("a.bag/camera/camera_info")
LENS = (0.1, -0.2, 0.001, 0.002, 0.03)


@pytest.fixture(params=["ros1", "ros2"])
def bags(request: pytest.FixtureRequest, recorder: Callable[..., Any]) -> Any:
    return recorder(request.param)


@pytest.mark.parametrize(
    ("model", "d"),
    [
        ("plumb_bob", LENS),
        ("rational_polynomial", (*LENS, 0.0, 0.0, 0.0)),
        ("rational_polynomial", (*LENS, *[0.0] * 9)),
    ],
)
def test_a_camera_is_read_exactly(bags: Any, model: str, d: tuple[float, ...]) -> None:
    camera = replace(bags.camera, distortion=LENS)
    assert camera_of_info(bags.info(camera, distortion_model=model, d=d), PATH) == camera


def test_four_coefficients_leave_the_fifth_at_0(bags: Any) -> None:
    camera = camera_of_info(bags.info(bags.camera, d=LENS[:4]), PATH)
    assert camera.distortion == (*LENS[:4], 0.0)


@pytest.mark.parametrize("model", ["", "plumb_bob", "equidistant"])
@pytest.mark.parametrize("d", [(), (0.0,) * 4, (0.0,) * 8])
def test_a_lens_that_does_nothing_is_of_any_model(bags: Any, model: str, d: Any) -> None:
    message = bags.info(bags.camera, distortion_model=model, d=d)
    assert camera_of_info(message, PATH) == bags.camera


@pytest.mark.parametrize(
    ("model", "d"),
    [
        ("equidistant", (0.1, 0.0, 0.0, 0.0)),
        ("", LENS),
        ("rational_polynomial", (*LENS, 0.1, 0.0, 0.0)),
    ],
)
def test_another_lens_is_refused(bags: Any, model: str, d: Any) -> None:
    message = bags.info(bags.camera, distortion_model=model, d=d)
    with pytest.raises(SlamError, match=r"--input\.camera FILE\.toml: ") as caught:
        camera_of_info(message, PATH)
    assert repr(model) in str(caught.value) and str(caught.value).endswith(str(PATH))


@pytest.mark.parametrize("camera", FREIBURG.values())
def test_cameras_of_the_benchmark_are_told_by_their_numbers(bags: Any, camera: Any) -> None:
    assert camera_of_info(bags.info(camera), PATH) == camera
    other = replace(camera, cx=camera.cx + 0.1, depth_scale=1000.0, readout_s=0.0)
    assert camera_of_info(bags.info(other), PATH) == other
    bent = replace(camera, distortion=LENS, depth_scale=1000.0, readout_s=0.0)
    assert camera_of_info(bags.info(bent), PATH) == bent


def test_rectified_images_are_those_of_p(bags: Any) -> None:
    bent = replace(bags.camera, distortion=LENS)
    p = [28.0, 0.0, 14.0, 0.0, 0.0, 29.0, 12.0, 0.0, 0.0, 0.0, 1.0, 0.0]
    camera = camera_of_info(bags.info(bent, p=p), PATH, is_rectified=True)
    assert camera == replace(bags.camera, fx=28.0, fy=29.0, cx=14.0, cy=12.0)
    camera = camera_of_info(bags.info(bent, p=[0.0] * 12), PATH, is_rectified=True)
    assert camera == bags.camera


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"fx": 0.0}, "camera key fx = 0.0"),
        ({"fy": float("nan")}, "camera key fy = nan"),
        ({"width": 0}, "camera key width = 0"),
        ({"cx": 50.0}, "cx, cy = 50"),
    ],
)
def test_a_camera_that_cannot_be_is_named(bags: Any, changes: Any, said: str) -> None:
    with pytest.raises(SlamError, match=said) as caught:
        camera_of_info(bags.info(replace(bags.camera, **changes)), PATH)
    assert str(caught.value).endswith(str(PATH))
