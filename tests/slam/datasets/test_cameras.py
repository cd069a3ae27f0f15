# SPDX-License-Identifier: Apache-2.0
import json
import re
from pathlib import Path

import numpy as np
import pytest

from slam.config import InputConfig
from slam.datasets import read_camera, write_camera
from slam.datasets.cameras import (
    FREIBURG,
    camera_of_matrix,
    freiburg_camera,
    named_camera,
    read_intrinsics,
    rescaled,
)
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


PINHOLE = {"fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.25}
ROWS = [[30.0, 0.0, 15.5], [0.0, 31.0, 11.25], [0.0, 0.0, 1.0]]
COLUMNS = [list(column) for column in zip(*ROWS, strict=True)]
SIZE = {"width": 32, "height": 24}


def flat(matrix):
    return [value for row in matrix for value in row]


@pytest.mark.parametrize(
    "values",
    [
        {**SIZE, **PINHOLE},
        {**SIZE, "fx": 30.0, "fy": 31.0, "ppx": 15.5, "ppy": 11.25, "coeffs": [0.0] * 5},
        {"w": 32, "h": 24, **PINHOLE, "scale": 1000.0},
        {"w": 32, "h": 24, "fl_x": 30.0, "fl_y": 31.0, "cx": 15.5, "cy": 11.25},
        {"camera": {"w": 32, "h": 24, **PINHOLE, "scale": 1000.0}},
        {"camera": {**SIZE, **PINHOLE}},
        {"intrinsics": {**SIZE, **PINHOLE}, "depth_scale": 0.001},
        {**SIZE, "color": {"fx": 30.0, "fy": 31.0, "ppx": 15.5, "ppy": 11.25}},
        {**SIZE, "intrinsic_matrix": flat(COLUMNS)},
        {**SIZE, "intrinsic_matrix": flat(ROWS)},
        {**SIZE, "intrinsic_matrix": ROWS},
        {**SIZE, "intrinsic_matrix": COLUMNS},
        {**SIZE, "K": ROWS, "D": [0.0] * 5, "distortion_model": "plumb_bob"},
        {**SIZE, "intrinsics": ROWS},
        {**SIZE, "camera": {"K": flat(ROWS)}},
        {**SIZE, "K": [[*row, 0.0] for row in ROWS] + [[0.0, 0.0, 0.0, 1.0]]},
        {**SIZE, "camera_matrix": {"rows": 3, "cols": 3, "data": flat(ROWS)}},
        {"image_width": 32, "image_height": 24, "camera_matrix": {"data": flat(ROWS)}},
    ],
)
def test_intrinsics_are_read_whatever_they_are_called_and_however_they_are_laid_out(
    tmp_path, values
):
    file = tmp_path / "intrinsic.json"
    file.write_text(json.dumps(values))
    camera = read_intrinsics(file)
    assert camera == Camera(32, 24, 30.0, 31.0, 15.5, 11.25, depth_scale=1000.0)


@pytest.mark.parametrize(
    "lens",
    [
        {"coeffs": [0.1, -0.2, 0.001, 0.002, 0.03], "model": "distortion.brown_conrady"},
        {"D": [0.1, -0.2, 0.001, 0.002, 0.03]},
        {"dist_coeffs": [[0.1, -0.2, 0.001, 0.002, 0.03]]},
        {"distortion_coefficients": {"data": [0.1, -0.2, 0.001, 0.002, 0.03]}},
        {"k1": 0.1, "k2": -0.2, "p1": 0.001, "p2": 0.002, "k3": 0.03},
    ],
)
def test_the_lens_is_read_whatever_it_is_called(tmp_path, lens):
    file = tmp_path / "intrinsic.json"
    file.write_text(json.dumps({**SIZE, **PINHOLE, **lens}))
    assert read_intrinsics(file).distortion == (0.1, -0.2, 0.001, 0.002, 0.03)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({**SIZE, "fx": 3.0, "fy": 3.0}, "the camera key cx is missing; what is read is width, "),
        (PINHOLE, "the camera key width is missing; what is read is width, "),
        ({**SIZE, "K": [[1, 2], [3, 4]]}, "K does not have 9 numbers"),
        ({**SIZE, "K": None}, "K does not have 9 numbers"),
        ({**SIZE, "K": {"data": 3}}, "K does not have 9 numbers"),
        ({**SIZE, **PINHOLE, "D": [0.1] * 4, "model": "fisheye"}, "lens model 'fisheye'"),
        ({**SIZE, **PINHOLE, "D": ["x"] * 5}, "camera key distortion"),
        ({**SIZE, **PINHOLE, "D": [0.1] * 8}, "camera key distortion"),
    ],
)
def test_intrinsics_that_lack_something_say_what_is_read(tmp_path, values, said):
    file = tmp_path / "intrinsic.json"
    file.write_text(json.dumps(values))
    with pytest.raises(SlamError, match=re.escape(said)) as caught:
        read_intrinsics(file)
    assert str(caught.value).endswith(str(file))


@pytest.mark.parametrize("matrix", [ROWS, COLUMNS])
def test_a_matrix_is_read_by_rows_or_by_columns(matrix):
    camera = camera_of_matrix(np.array(matrix), (32, 24), Path("K.txt"))
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == tuple(PINHOLE.values())
