# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slam.datasets.bags.bag import Bag
from slam.datasets.bags.transforms import fixed_transform, rigid_of
from slam.geometry import se3
from slam.types import FloatArray, SlamError


def motion(*tangent: float) -> FloatArray:
    return se3.exp(np.array(tangent))


T_BASE_CAMERA = motion(0.1, -0.2, 0.3, 1.0, 2.0, 3.0)
T_CAMERA_COLOR = motion(0.0, 0.5, 0.0, 0.1, 0.0, 0.0)
T_CAMERA_DEPTH = motion(0.02, 0.0, 0.01, -0.1, 0.0, 0.02)


def test_steps_up_and_down_are_put_together(of_every_kind: Any) -> None:
    bags = of_every_kind
    bags.add("/tf_static", bags.transforms(("base", "camera", T_BASE_CAMERA)))
    bags.add(
        "/tf_static",
        bags.transforms(("camera", "color", T_CAMERA_COLOR), ("/camera", "/depth", T_CAMERA_DEPTH)),
    )
    bag = Bag(bags.write())
    for (a, b), T_a_b in {
        ("color", "depth"): se3.inverse(T_CAMERA_COLOR) @ T_CAMERA_DEPTH,
        ("base", "/color"): T_BASE_CAMERA @ T_CAMERA_COLOR,
        ("depth", "base"): se3.inverse(T_BASE_CAMERA @ T_CAMERA_DEPTH),
        ("color", "color"): np.eye(4),
    }.items():
        found = fixed_transform(bag, a, b)
        assert found is not None
        np.testing.assert_allclose(found, T_a_b, atol=1e-12)
    assert fixed_transform(bag, "color", "elsewhere") is None


def test_what_tf_repeats_is_fixed_and_what_it_changes_is_not(of_every_kind: Any) -> None:
    bags = of_every_kind
    for i in range(3):
        T_odom_base = motion(0.0, 0.0, 0.0, 0.1 * i, 0.0, 0.0)
        bags.add("/tf", bags.transforms(("odom", "base", T_odom_base)))
        bags.add("/tf", bags.transforms(("base", "camera", T_BASE_CAMERA)))
    bag = Bag(bags.write())
    found = fixed_transform(bag, "base", "camera")
    assert found is not None
    np.testing.assert_allclose(found, T_BASE_CAMERA, atol=1e-12)
    assert fixed_transform(bag, "odom", "camera") is None


def test_frames_in_a_circle_are_no_trouble(recorder: Callable[..., Any]) -> None:
    bags = recorder()
    steps = [("a", "b"), ("b", "c"), ("c", "a")]
    bags.add("/tf_static", bags.transforms(*((a, b, np.eye(4)) for a, b in steps)))
    bag = Bag(bags.write())
    assert fixed_transform(bag, "a", "c") is not None
    assert fixed_transform(bag, "a", "d") is None


def test_a_bag_without_transforms_joins_nothing(recorder: Callable[..., Any]) -> None:
    bags = recorder()
    bags.frames(1)
    assert fixed_transform(Bag(bags.write()), "a", "b") is None


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_transform_that_is_none_is_named(recorder: Callable[..., Any], value: float) -> None:
    bags = recorder()
    T = np.eye(4)
    T[1, 3] = value
    bags.add("/tf_static", bags.transforms(("base", "camera", T)))
    with pytest.raises(SlamError, match="the transform from camera to base on /tf_static is no"):
        fixed_transform(Bag(bags.write()), "base", "camera")


def test_a_quaternion_may_have_any_length_but_0() -> None:
    position = SimpleNamespace(x=1.0, y=2.0, z=3.0)
    T = rigid_of(position, SimpleNamespace(x=0.0, y=0.0, z=3.0, w=3.0))
    assert T is not None
    np.testing.assert_allclose(
        T, motion(0.0, 0.0, 0.0, 1.0, 2.0, 3.0) @ motion(0, 0, np.pi / 2, 0, 0, 0), atol=1e-12
    )
    assert rigid_of(position, SimpleNamespace(x=0.0, y=0.0, z=0.0, w=0.0)) is None
    assert rigid_of(position, SimpleNamespace(x=0.0, y=0.0, z=np.nan, w=1.0)) is None
