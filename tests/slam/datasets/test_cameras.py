# SPDX-License-Identifier: Apache-2.0
import re
from pathlib import Path

import pytest

from slam.config import InputConfig
from slam.datasets import read_camera, write_camera
from slam.datasets.cameras import FREIBURG, freiburg_camera, named_camera, rescaled
from slam.types import Camera, SlamError

GOOD = {
    "width": "640",
    "height": "480",
    "fx": "500.0",
    "fy": "500",
    "cx": "320.0",
    "cy": "240.0",
    "depth_scale": "1000",
}


def write(path: Path, **changes: str | None) -> Path:
    keys = {**GOOD, **changes}
    path.write_text("".join(f"{k} = {v}\n" for k, v in keys.items() if v is not None))
    return path


def test_a_written_camera_is_read_back_exactly(tmp_path: Path) -> None:
    lens = (0.1, -1e-7, 0.0, 2.5, 1e-20)
    camera = Camera(640, 480, 517.3, 1 / 3, 318.6, 255.3, lens, 1000.0, 0.02, 1 / 700)
    write_camera(tmp_path / "camera.toml", camera)
    assert read_camera(tmp_path / "camera.toml") == camera
    assert [path.name for path in tmp_path.iterdir()] == ["camera.toml"]


def test_distortion_may_be_left_out_or_have_four_numbers(tmp_path: Path) -> None:
    path = tmp_path / "camera.toml"
    assert read_camera(write(path)).distortion == (0.0,) * 5
    four = read_camera(write(path, distortion="[0.1, 0.2, 0.3, 0.4]"))
    assert four.distortion == (0.1, 0.2, 0.3, 0.4, 0.0)


def test_a_camera_whose_depth_noise_is_not_told_has_a_kinects(tmp_path: Path) -> None:
    assert read_camera(write(tmp_path / "camera.toml")).depth_noise_m == 0.0025


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"fx": "-500"}, "camera key fx = -500"),
        ({"fy": "0"}, "camera key fy = 0"),
        ({"fy": "inf"}, "camera key fy = inf"),
        ({"fx": "nan"}, "camera key fx = nan"),
        ({"width": "640.5"}, "camera key width = 640.5"),
        ({"depth_scale": "0"}, "camera key depth_scale = 0"),
        ({"cx": "640"}, "cx, cy = 640, 240 lie outside the image of 640x480"),
        ({"cy": "-1"}, "cx, cy = 320, -1 lie outside"),
        ({"cx": "nan"}, "camera key cx = nan"),
        ({"depth_noise_m": "0"}, "camera key depth_noise_m = 0"),
        ({"distortion": "[0.1, 0.2]"}, "camera key distortion"),
        ({"distortion": "[0, 0, 0, 0, 0, 0]"}, "camera key distortion"),
        ({"fx": '"wide"'}, "camera key fx = 'wide'"),
        ({"width": "9000", "height": "9000"}, "an image of 9000x9000 pixels, more than 67"),
        ({"depth_scale": "1e300"}, "camera key depth_scale = 1e+300"),
        ({"focal": "3"}, "no camera key focal; the keys are width, height, fx"),
        ({"depth_scale": None}, "camera key depth_scale is missing"),
        ({"width": "= ="}, "not valid TOML"),
    ],
)
def test_a_bad_camera_file_is_one_line_that_names_key_and_file(
    tmp_path: Path, changes: dict[str, str | None], said: str
) -> None:
    path = write(tmp_path / "mine.toml", **changes)
    with pytest.raises(SlamError, match=re.escape(said)) as caught:
        read_camera(path)
    assert str(caught.value).endswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_missing_camera_file_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(SlamError, match="cannot read the camera file"):
        read_camera(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("rgbd_dataset_freiburg1_desk", "1"),
        ("fr2_xyz", "2"),
        ("my-FR3-walk", "3"),
        ("Freiburg3", "3"),
    ],
)
def test_the_folder_name_says_which_freiburg_camera(tmp_path: Path, name: str, number: str) -> None:
    assert freiburg_camera(tmp_path / name) == FREIBURG[number]


@pytest.mark.parametrize("name", ["kitchen", "fr4_desk", "fr12", "afr1"])
def test_an_unknown_camera_says_how_to_write_one(tmp_path: Path, name: str) -> None:
    with pytest.raises(SlamError, match=r"--input\.camera") as caught:
        freiburg_camera(tmp_path / name)
    assert all(key in str(caught.value) for key in (*GOOD, "distortion", "camera.toml"))


def test_the_users_file_goes_before_the_folders(tmp_path: Path) -> None:
    assert named_camera(tmp_path, InputConfig()) is None
    write(tmp_path / "camera.toml", fx="400")
    in_folder = named_camera(tmp_path, InputConfig())
    users = named_camera(tmp_path, InputConfig(camera=write(tmp_path / "own.toml", fx="300")))
    assert in_folder is not None and users is not None
    assert (in_folder.fx, users.fx) == (400.0, 300.0)


def test_a_given_depth_scale_overrides_the_cameras() -> None:
    assert rescaled(FREIBURG["1"], InputConfig()) == FREIBURG["1"]
    assert rescaled(FREIBURG["1"], InputConfig(depth_scale=1000.0)).depth_scale == 1000.0
