# SPDX-License-Identifier: Apache-2.0
"""Cameras as other programs write them down."""

import json
from pathlib import Path
from typing import Any

from slam.datasets.cameras import camera_of
from slam.types import Camera, SlamError

UNITS_PER_M = 1000.0
"""The depth scale of nearly every sensor but the TUM benchmark's."""


def read_intrinsics(file: Path) -> Camera:
    """Read a JSON file as Open3D writes it, or with the attributes of pyrealsense2's intrinsics.

    The first has width, height and intrinsic_matrix (by columns); the second width, height, fx,
    fy, ppx, ppy, model and coeffs. Either may have depth_scale: Open3D's, 1000 or so, are units
    per metre; a RealSense's, 0.001 or so, are metres per unit.

    Raises:
        SlamError: the file cannot be read, or a value is missing or out of range.
    """
    try:
        values = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise SlamError(f"cannot read the camera file: {error.strerror}: {file}") from error
    except ValueError as error:
        raise SlamError(f"the camera file is not valid JSON: {error}: {file}") from error
    if not isinstance(values, dict):
        raise SlamError(f"the camera file does not hold names and values: {file}")
    pinhole = (
        _of_matrix(values, file) if "intrinsic_matrix" in values else _of_realsense(values, file)
    )
    scale = values.get("depth_scale", UNITS_PER_M)
    if isinstance(scale, float) and 0.0 < scale < 1.0:
        scale = 1.0 / scale
    size = {key: values[key] for key in ("width", "height") if key in values}
    return camera_of({**size, **pinhole, "depth_scale": scale}, file)


def _of_matrix(values: dict[str, Any], file: Path) -> dict[str, object]:
    matrix = values["intrinsic_matrix"]
    if not isinstance(matrix, list) or len(matrix) != 9:
        raise SlamError(f"intrinsic_matrix does not have 9 numbers, column by column: {file}")
    return {"fx": matrix[0], "fy": matrix[4], "cx": matrix[6], "cy": matrix[7]}


def _of_realsense(values: dict[str, Any], file: Path) -> dict[str, object]:
    names = {"fx": "fx", "fy": "fy", "ppx": "cx", "ppy": "cy"}
    pinhole = {ours: values[theirs] for theirs, ours in names.items() if theirs in values}
    coefficients, model = values.get("coeffs", [0.0] * 5), str(values.get("model", ""))
    if not any(coefficients):
        return pinhole
    # Inverse or not, librealsense projects with OpenCV's formula (rs2_project_point_to_pixel).
    if "brown_conrady" not in model:
        raise SlamError(
            f"the lens model {model!r} is not known, only brown_conrady is; name the camera by"
            f" --input.camera FILE.toml: {file}"
        )
    return {**pinhole, "distortion": coefficients}
