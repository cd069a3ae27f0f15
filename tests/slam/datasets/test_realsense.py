# SPDX-License-Identifier: Apache-2.0
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam.config import InputConfig
from slam.datasets import Sequence, open_sequence
from slam.types import SlamError

Export = Callable[[str, Any], Path]


@pytest.fixture
def tiny(export: Export, tiny_walk: Any) -> Path:
    return export("realsense", tiny_walk)


def opened(folder: Path) -> Sequence:
    return open_sequence(folder, InputConfig())


def fails(folder: Path, said: str) -> str:
    with pytest.raises(SlamError, match=re.escape(said)) as caught:
        list(opened(folder))
    assert "\n" not in str(caught.value)
    return str(caught.value)


def change(file: Path, **values: object) -> None:
    file.write_text(json.dumps({**json.loads(file.read_text()), **values}))


def test_frames_have_the_times_of_the_list_and_the_scale_of_the_device(tiny: Path) -> None:
    change(tiny / "intrinsics.json", depth_scale=0.0005)
    sequence = opened(tiny)
    assert sequence.camera.depth_scale == pytest.approx(2000.0)
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(6) / 30.0, atol=1e-6)
    for i, frame in enumerate(sequence):
        assert frame.rgb[0, 0, 0] == i
        np.testing.assert_allclose(frame.depth_m, 0.5 * (1.0 + i / 10.0), atol=1e-6)
    assert sequence.warnings == ("timestamps.csv steps by 33.3333 and was read as milliseconds",)


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("timestamps.csv", "{i},{s:.6f}"),
        ("timestamps.csv", "color/{i:05d}.png,{s:.6f},7"),
        ("timestamps.txt", "{i:05d}.png {s:.6f}"),
        ("timestamps.txt", "{s:.6f}"),
    ],
)
def test_the_list_may_name_images_or_just_give_times(tiny: Path, name: str, line: str) -> None:
    (tiny / "timestamps.csv").unlink()
    start_s = 1700000000.0
    lines = [line.format(i=i, s=start_s + i / 15.0) for i in range(6)]
    (tiny / name).write_text("\n".join(lines))
    sequence = opened(tiny)
    np.testing.assert_allclose(sequence.timestamps_s - start_s, np.arange(6) / 15.0, atol=1e-5)
    assert sequence.warnings == ()


def test_times_out_of_order_put_the_images_in_order(tiny: Path) -> None:
    (tiny / "timestamps.csv").write_text("".join(f"{i},{5 - i}e-1\n" for i in range(6)))
    sequence = opened(tiny)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == [5, 4, 3, 2, 1, 0]
    assert sequence.warnings == ("timestamps.csv is not in the order of time; it was sorted",)


def test_images_without_a_time_are_left_out_and_said(tiny: Path) -> None:
    (tiny / "timestamps.csv").write_text("frame,time\n0,0.0\n2,0.1\n5,0.2\n9,0.3\n")
    sequence = opened(tiny)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == [0, 2, 5]
    assert sequence.warnings == ("3 of 6 images have no line in timestamps.csv and are not used",)


def test_a_missing_depth_image_is_skipped(tiny: Path) -> None:
    (tiny / "depth/00002.png").unlink()
    sequence = opened(tiny)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == [0, 1, 3, 4, 5]
    assert sequence.skipped == [(tiny / "depth/00002.png", "the file is missing")]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the list holds no time"),
        ("frame,time\n", "the list holds no time"),
        ("0,0.0\n1,soon\n", "line 2 is neither"),
        ("0,0.0\n1,nan\n", "line 2 is neither"),
        ("0,0.0,x\n1,soon,x\n", "line 2 is neither"),
        ("0,0.0\n1\n", "some lines name an image"),
        ("0,0.0\nred,0.1\n", "line 2 is neither"),
        ("0,0.0\n1.5,0.1\n", "line 2 is neither"),
        ("0.0\n0.1\n0.2\n", "there are 3 times for 6 images"),
        ("7,0.0\n8,0.1\n", "no line is of an image in color/"),
        ("0,0\n1,33000000\n2,66000000\n", "seconds or milliseconds are expected"),
    ],
)
def test_a_list_that_is_wrong_is_named(tiny: Path, text: str, said: str) -> None:
    (tiny / "timestamps.csv").write_text(text)
    assert fails(tiny, said).endswith("timestamps.csv")


@pytest.mark.parametrize(
    "model", ["brown_conrady", "inverse_brown_conrady", "distortion.modified_brown_conrady"]
)
def test_the_lens_is_opencvs_however_it_is_called(tiny: Path, model: str) -> None:
    change(tiny / "intrinsics.json", coeffs=[0.1, -0.2, 0.001, 0.002, 0.03], model=model)
    assert opened(tiny).camera.distortion == (0.1, -0.2, 0.001, 0.002, 0.03)


def test_another_lens_model_is_refused_unless_it_does_nothing(tiny: Path) -> None:
    change(tiny / "intrinsics.json", model="ftheta")
    assert opened(tiny).camera.distortion == (0.0,) * 5
    change(tiny / "intrinsics.json", coeffs=[0.1, 0.0, 0.0, 0.0, 0.0])
    assert "--input.camera" in fails(tiny, "the lens model 'ftheta' is not known")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"fx": "wide"}, "camera key fx = 'wide'"),
        ({"coeffs": [0.1, 0.2]}, "camera key distortion"),
        ({"ppx": 99.0}, "cx, cy = 99"),
    ],
)
def test_a_camera_that_cannot_be_is_named(tiny: Path, values: dict[str, object], said: str) -> None:
    change(tiny / "intrinsics.json", **values)
    assert fails(tiny, said).endswith("intrinsics.json")
