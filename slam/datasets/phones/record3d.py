# SPDX-License-Identifier: Apache-2.0
"""Exports of Record3D, an app for iPhones with LiDAR, as "EXR + JPG sequence": rgb/, depth/ ...

Their layout is described by its author in https://github.com/marek-simonik/record3d/issues (27, 67,
121). No export of a real phone was at hand when this was written, so that how its OpenEXR images
are compressed is not known: those that are not by ZIP are refused.
"""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placerec.datasets.images import BrokenImage
from placerec.datasets.times import in_seconds
from placerec.files import read_json
from slam.config import InputConfig
from slam.datasets.cameras import camera_of_matrix, named_camera, rescaled
from slam.datasets.images import FRAMES_PER_S, numbered_images, read_color, read_exr
from slam.datasets.phones.fitting import Fitting
from slam.datasets.sequence import ImagePair, Sequence, pairs_in_order
from slam.types import Camera, SlamError

_DEPTH_NAME = re.compile(r"(\d+)\.exr")
_VARIES = 0.02


def open_record3d(path: Path, config: InputConfig) -> Sequence:
    """Open rgb/0.jpg, depth/0.exr (metres), ... and metadata.json.

    Times are its frameTimestamps, or follow its fps. Its poses are the phone's estimate, no truth.

    Raises:
        SlamError: it is an unpacked .r3d, or something cannot be used.
    """
    if (path / "rgbd").is_dir():
        raise SlamError(
            "depth in a .r3d is compressed by LZFSE, which is not read here; export the recording"
            f' from Record3D as "EXR + JPG sequence": {path}'
        )
    warnings: list[str] = []
    file = path / "metadata.json"
    metadata = _read_metadata(file)
    colors = numbered_images(path / "rgb")
    depths = numbered_images(path / "depth", _DEPTH_NAME)
    camera = named_camera(path, config) or _read_camera(metadata, file, warnings)
    fitting = Fitting(rescaled(camera, config))
    units_per_m = fitting.color_camera.depth_scale
    stamps_s = _read_times(metadata, list(colors), file, warnings)
    images = [
        ImagePair(stamps_s[n], color, depths.get(n, path / "depth" / f"{n}.exr"))
        for n, color in colors.items()
    ]
    images, ends_s = pairs_in_order(images, file, warnings)
    return Sequence(
        path.resolve().name,
        fitting.camera,
        images,
        warnings=tuple(warnings),
        session_ends_s=ends_s,
        read_color_file=lambda file: fitting.fit_color(read_color(file), file),
        read_depth_file=lambda file: fitting.fit_depth(_read_depth(file, units_per_m), file),
    )


def _read_metadata(file: Path) -> dict[str, Any]:
    metadata = read_json(file, kind=SlamError)
    if not isinstance(metadata, dict):
        raise SlamError(f"the file does not hold names and values: {file}")
    return metadata


def _read_camera(metadata: dict[str, Any], file: Path, warnings: list[str]) -> Camera:
    """Return the colour camera; the phone's focus changes its focal length, so the middle one."""
    matrix = _numbers(metadata, "K", file)
    if matrix.shape != (9,):
        raise SlamError(f"K does not have 9 numbers, column by column: {file}")
    K = matrix.reshape(3, 3).T.copy()
    if metadata.get("perFrameIntrinsicCoeffs"):
        each = _numbers(metadata, "perFrameIntrinsicCoeffs", file)
        if each.ndim != 2 or each.shape[1] != 4:
            raise SlamError(f"perFrameIntrinsicCoeffs is not fx, fy, cx, cy of each frame: {file}")
        K[0, 0], K[1, 1], K[0, 2], K[1, 2] = np.median(each, axis=0)
        least, most = each[:, 0].min(), each[:, 0].max()
        if most - least > _VARIES * K[0, 0]:
            warnings.append(
                f"the focal length changes from {least:.0f} to {most:.0f} px along the recording;"
                f" {K[0, 0]:.0f} px, the median, is taken for all of it"
            )
    size: tuple[Any, Any] = metadata.get("w"), metadata.get("h")
    return replace(camera_of_matrix(K, size, file), depth_scale=1.0)


def _read_times(
    metadata: dict[str, Any], frames: list[int], file: Path, warnings: list[str]
) -> dict[int, float]:
    """Return the time, seconds, of each of the frames, which increase."""
    count = frames[-1] + 1
    if metadata.get("frameTimestamps"):
        stamps_s = _numbers(metadata, "frameTimestamps", file)
        if stamps_s.ndim != 1 or len(stamps_s) < count:
            raise SlamError(f"frameTimestamps are {len(stamps_s)}, for {count} images: {file}")
        stamps_s = in_seconds(stamps_s, file, warnings)
        return {frame: float(stamps_s[frame]) for frame in frames}
    rate = _numbers(metadata, "fps", file) if "fps" in metadata else np.array(FRAMES_PER_S)
    if rate.ndim or rate <= 0.0:
        raise SlamError(f"fps = {metadata['fps']} is no frame rate: {file}")
    return {frame: frame / float(rate) for frame in frames}


def _numbers(metadata: dict[str, Any], key: str, file: Path) -> NDArray[np.float64]:
    """Return what a key holds, finite numbers, nested in lists or not."""
    try:
        values = np.array(metadata[key], dtype=np.float64)
    except KeyError:
        raise SlamError(f"the key {key} is missing: {file}") from None
    except (TypeError, ValueError, OverflowError):
        raise SlamError(f"the key {key} does not hold numbers: {file}") from None
    if not np.isfinite(values).all():
        raise SlamError(f"the key {key} holds a number that is not finite: {file}")
    return values


def _read_depth(path: Path, depth_scale: float) -> NDArray[np.float32] | BrokenImage:
    depth = read_exr(path)
    if isinstance(depth, BrokenImage):
        return depth
    is_known = np.isfinite(depth) & (depth > 0.0)
    return np.where(is_known, depth / np.float32(depth_scale), np.float32(0.0))
