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

    One that is written by columns is turned.

    Depth is in millimetres. `file` is where the matrix is from.

    Raises:
        SlamError: a value is out of range.
    """
    width, height = size
    if not K[:2, 2].any() and K[2, :2].any():
        K = K.T
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


_GROUPS = ("camera", "intrinsics", "intrinsic", "color", "rgb", "depth_intrinsics")
_MATRICES = ("intrinsic_matrix", "camera_matrix", "K", "k", "matrix", "intrinsics", "intrinsic")
_COEFFICIENTS = ("coeffs", "distortion", "distortion_coefficients", "dist_coeffs", "D", "d")
_NAMES = {
    "width": ("width", "w", "image_width"),
    "height": ("height", "h", "image_height"),
    "fx": ("fx", "fl_x"),
    "fy": ("fy", "fl_y"),
    "cx": ("cx", "ppx"),
    "cy": ("cy", "ppy"),
    "depth_scale": ("depth_scale", "scale", "png_depth_scale"),
}
_READ = (
    "width, height, fx, fy, cx, cy (or ppx, ppy) or an intrinsic_matrix of nine numbers, and"
    " depth_scale; these within camera or intrinsics too"
)


def read_intrinsics(file: Path, usual_scale: float | None = UNITS_PER_M) -> Camera:
    """Read a JSON file of the names that Open3D, NICE-SLAM, pyrealsense2, ROS and others use.

    A matrix may be flat or nested, by rows or by columns: the camera's centre tells. All may be
    within a group such as camera. Coefficients of the lens are OpenCV's, and depth_scale is units
    per metre or, as a RealSense's 0.001 is, metres per unit; without one it is the usual scale, if
    there is one.

    Raises:
        SlamError: the file cannot be read, or a value is missing or out of range.
    """
    values = read_json(file, what=_WHAT, kind=SlamError)
    if not isinstance(values, dict):
        raise SlamError(f"the camera file does not hold names and values: {file}")
    for group in _GROUPS:
        if isinstance(values.get(group), dict):
            values = {**values, **values[group]}
            break
    camera = {
        ours: values[theirs]
        for ours, names in _NAMES.items()
        for theirs in names[::-1]
        if theirs in values
    }
    matrix = next((name for name in _MATRICES if name in values), None)
    if matrix is not None and not {"fx", "fy", "cx", "cy"} <= camera.keys():
        camera |= _of_matrix(values[matrix], matrix, file)
    if usual_scale is not None:
        camera.setdefault("depth_scale", usual_scale)
    if missing := [name for name in _NAMES if name not in camera]:
        raise SlamError(f"the camera key {missing[0]} is missing; what is read is {_READ}: {file}")
    scale = camera["depth_scale"]
    if isinstance(scale, float) and 0.0 < scale < 1.0:
        camera["depth_scale"] = 1.0 / scale
    return camera_of({**camera, **_lens(values, file)}, file)


def _of_matrix(matrix: Any, name: str, file: Path) -> dict[str, object]:
    """Return the values of a (3, 3) or larger matrix, whichever way it is written."""
    if isinstance(matrix, dict):  # as OpenCV writes matrices
        matrix = matrix.get("data")
    rows = matrix if isinstance(matrix, list) else []
    flat = [value for row in rows for value in (row if isinstance(row, list) else [row])]
    if len(flat) not in (9, 16):
        raise SlamError(f"{name} does not have 9 numbers, by rows or by columns: {file}")
    size = 3 if len(flat) == 9 else 4
    right, down, below = flat[2], flat[size + 2], flat[2 * size : 2 * size + 2]
    if not (right or down) and any(below):
        right, down = below
    return {"fx": flat[0], "fy": flat[size + 1], "cx": right, "cy": down}


def _lens(values: dict[str, Any], file: Path) -> dict[str, object]:
    """Return the coefficients of the lens, none where it does not distort.

    Raises:
        SlamError: they are of a model that is not OpenCV's.
    """
    named = next((values[name] for name in _COEFFICIENTS if name in values), None)
    if named is None and "k1" in values:
        named = [values.get(name, 0.0) for name in ("k1", "k2", "p1", "p2", "k3")]
    if isinstance(named, dict):
        named = named.get("data")
    coefficients = [] if named is None else named
    if not isinstance(coefficients, list):
        raise SlamError(f"the lens's coefficients {named!r} are no list of numbers: {file}")
    coefficients = [
        value for row in coefficients for value in (row if isinstance(row, list) else [row])
    ]
    if not any(coefficients):
        return {}
    model = str(values.get("model", values.get("distortion_model", "plumb_bob"))).lower()
    # Inverse or not, librealsense projects with OpenCV's formula (rs2_project_point_to_pixel).
    if not any(known in model for known in ("brown_conrady", "plumb_bob", "opencv", "radtan")):
        raise SlamError(
            f"the lens model {model!r} is not known, only brown_conrady is; name the camera by"
            f" --input.camera FILE.toml: {file}"
        )
    return {"distortion": coefficients}
