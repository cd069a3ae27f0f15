# SPDX-License-Identifier: Apache-2.0
"""Which camera a recording was made with: the one that is named, or the format's own."""

import json
import re
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, ValidationError

from placerec.datasets.image_size import check_size
from placerec.files import read_json, read_toml, write_atomically
from slam.config import DepthScale, InputConfig, PositiveFloat, PositiveInt
from slam.types import Camera, FloatArray, SlamError

CAMERA_FILE = "camera.toml"
_WHAT = "the camera file"
UNITS_PER_M = 1000.0
"""The depth scale of nearly every sensor but the TUM benchmark's."""

# At which the error on fr1_xyz is smallest, of 14, 18, 20, 22, 26, 30 and 33 ms, rounded.
_KINECT_READOUT_S = 0.021
# Colour cameras of the TUM RGB-D benchmark: two Kinects, and a third camera whose images are
# already undistorted and whose shutter was not looked at.
_FREIBURG_1 = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
_FREIBURG_2 = (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
FREIBURG = {
    "1": Camera(640, 480, 517.3, 516.5, 318.6, 255.3, _FREIBURG_1, 5000.0, _KINECT_READOUT_S),
    "2": Camera(640, 480, 520.9, 521.0, 325.1, 249.7, _FREIBURG_2, 5000.0, _KINECT_READOUT_S),
    "3": Camera(640, 480, 535.4, 539.2, 320.1, 247.6, (0.0, 0.0, 0.0, 0.0, 0.0), 5000.0),
}
_FREIBURG_NAME = re.compile(r"(?:freiburg|(?<![a-z])fr)([123])(?!\d)", re.IGNORECASE)


class _CameraTable(BaseModel):
    """What a camera file may hold; the depth scale has no default because guesses go unseen."""

    model_config = ConfigDict(extra="forbid")

    width: PositiveInt
    height: PositiveInt
    fx: PositiveFloat
    fy: PositiveFloat
    cx: FiniteFloat
    cy: FiniteFloat
    distortion: Annotated[tuple[FiniteFloat, ...], Field(min_length=4, max_length=5)] = (0.0,) * 5
    depth_scale: DepthScale
    readout_s: Annotated[float, Field(ge=0.0, le=0.1)] = 0.0
    depth_noise_m: PositiveFloat = Camera.depth_noise_m


def named_camera(folder: Path, config: InputConfig) -> Camera | None:
    """Return the camera the user names, else the folder's camera.toml, else None.

    Raises:
        SlamError: the camera file is not usable.
    """
    if config.camera is not None:
        return read_camera(config.camera)
    return read_camera(folder / CAMERA_FILE) if (folder / CAMERA_FILE).is_file() else None


def rescaled(camera: Camera, config: InputConfig) -> Camera:
    """Return the camera with the depth scale that the user names, if any."""
    return camera if config.depth_scale is None else replace(camera, depth_scale=config.depth_scale)


def is_freiburg(path: Path) -> bool:
    """Return whether a name tells a camera of the TUM RGB-D benchmark."""
    return bool(_FREIBURG_NAME.search(path.resolve().name))


def freiburg_camera(folder: Path) -> Camera:
    """Return the camera of the TUM RGB-D benchmark that the folder's name tells.

    Raises:
        SlamError: the name tells none.
    """
    if named := _FREIBURG_NAME.search(folder.resolve().name):
        return FREIBURG[named[1]]
    raise SlamError(
        "which camera made this sequence is not known: its folder's name says neither fr1, fr2 nor"
        f" fr3; put a {CAMERA_FILE} into it, or give --input.camera FILE.toml, with the keys width,"
        " height, fx, fy, cx, cy (pixels), depth_scale (depth image units per metre) and, if the"
        " lens distorts, distortion = [k1, k2, p1, p2, k3]; for a rolling shutter, readout_s, the"
        " seconds from the first row to the last; for a sensor that is no Kinect, depth_noise_m,"
        f" the standard deviation of its depth at 1 m: {folder}"
    )


def read_camera(path: Path) -> Camera:
    """Read a camera from a TOML file.

    Raises:
        SlamError: the file is missing, is not TOML, or a key is missing, unknown or out of range.
    """
    return camera_of(read_toml(path, what=_WHAT, kind=SlamError), path)


def camera_of(values: Mapping[str, object], path: Path) -> Camera:
    """Return the camera of the keys and values that a file holds.

    Raises:
        SlamError: a key is missing, unknown or out of range.
    """
    try:
        table = _CameraTable.model_validate(values)
    except ValidationError as error:
        raise SlamError(f"{_describe(error)}: {path}") from error
    if not (0.0 <= table.cx < table.width and 0.0 <= table.cy < table.height):
        raise SlamError(
            f"camera keys cx, cy = {table.cx:g}, {table.cy:g} lie outside the image of"
            f" {table.width}x{table.height} pixels; they are the optical axis in pixels: {path}"
        )
    try:
        check_size(table.width, table.height)
    except ValueError as error:
        raise SlamError(f"camera keys width, height: {error}: {path}") from error
    return Camera(**{**table.model_dump(), "distortion": (*table.distortion, 0.0)[:5]})


def camera_of_matrix(K: FloatArray, size: tuple[int, int], file: Path) -> Camera:
    """Return the camera of a (3, 3) intrinsic matrix, or larger, and (width, height), pixels.

    Depth is in millimetres. `file` is where the matrix is from.

    Raises:
        SlamError: a value is out of range.
    """
    width, height = size
    values = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    pinhole = {key: float(value) for key, value in values.items()}
    return camera_of(
        {"width": width, "height": height, **pinhole, "depth_scale": UNITS_PER_M}, file
    )


def _describe(error: ValidationError) -> str:
    first = error.errors()[0]
    key = ".".join(str(part) for part in first["loc"])
    if first["type"] == "extra_forbidden":
        return f"there is no camera key {key}; the keys are {', '.join(_CameraTable.model_fields)}"
    if first["type"] == "missing":
        return f"the camera key {key} is missing"
    return f"camera key {key} = {first['input']!r}: {first['msg']}"


def write_camera(path: Path, camera: Camera) -> None:
    """Write a camera as TOML that `read_camera` reads back exactly.

    Raises:
        LoopcloseError: the file cannot be written.
    """
    keys = asdict(camera).items()
    write_atomically(path, "".join(f"{key} = {json.dumps(value)}\n" for key, value in keys))


_NICE_SLAM = {"w": "width", "h": "height", "scale": "depth_scale"}


def read_intrinsics(file: Path) -> Camera:
    """Read a JSON file of Open3D, NICE-SLAM, or with the attributes of pyrealsense2's intrinsics.

    The first has width, height and intrinsic_matrix (by columns); the second w, h, fx, fy, cx, cy
    and scale within camera; the third width, height, fx, fy, ppx, ppy, model and coeffs. All but
    the second may have depth_scale: Open3D's, 1000 or so, are units per metre; a RealSense's, 0.001
    or so, are metres per unit.

    Raises:
        SlamError: the file cannot be read, or a value is missing or out of range.
    """
    values = read_json(file, what=_WHAT, kind=SlamError)
    if not isinstance(values, dict):
        raise SlamError(f"the camera file does not hold names and values: {file}")
    if isinstance(values.get("camera"), dict):
        named = {_NICE_SLAM.get(key, key): value for key, value in values["camera"].items()}
        return camera_of(named, file)
    pinhole_of = _of_matrix if "intrinsic_matrix" in values else _of_realsense
    scale = values.get("depth_scale", UNITS_PER_M)
    if isinstance(scale, float) and 0.0 < scale < 1.0:
        scale = 1.0 / scale
    size = {key: values[key] for key in ("width", "height") if key in values}
    return camera_of({**size, **pinhole_of(values, file), "depth_scale": scale}, file)


def _of_matrix(values: dict[str, Any], file: Path) -> dict[str, object]:
    matrix = values["intrinsic_matrix"]
    if not isinstance(matrix, list) or len(matrix) != 9:
        raise SlamError(f"intrinsic_matrix does not have 9 numbers, column by column: {file}")
    return {"fx": matrix[0], "fy": matrix[4], "cx": matrix[6], "cy": matrix[7]}


def _of_realsense(values: dict[str, Any], file: Path) -> dict[str, object]:
    names = {"fx": "fx", "fy": "fy", "ppx": "cx", "ppy": "cy"}
    pinhole = {ours: values[theirs] for theirs, ours in names.items() if theirs in values}
    coefficients, model = values.get("coeffs", [0.0] * 5), str(values.get("model", ""))
    if not isinstance(coefficients, list):
        raise SlamError(f"coeffs = {coefficients!r} is no list of numbers: {file}")
    if not any(coefficients):
        return pinhole
    # Inverse or not, librealsense projects with OpenCV's formula (rs2_project_point_to_pixel).
    if "brown_conrady" not in model:
        raise SlamError(
            f"the lens model {model!r} is not known, only brown_conrady is; name the camera by"
            f" --input.camera FILE.toml: {file}"
        )
    return {**pinhole, "distortion": coefficients}
