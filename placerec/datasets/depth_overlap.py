# SPDX-License-Identifier: Apache-2.0
"""How much of what one camera sees another sees too, by depth images and poses."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, Field, ValidationError
from scipy.spatial.transform import Rotation

from placerec.datasets.images import BrokenImage, decode
from placerec.datasets.place_dataset import PlaceDataset
from placerec.datasets.tum_lists import nearest, read_images
from placerec.errors import RecognizerError
from placerec.files import read_json

FloatArray = NDArray[np.float64]

_CELL_PX = 16
"""Of every square of so many pixels one is looked at."""
_MAX_TIME_DIFFERENCE_S = 0.02
_NEAREST_M = 0.1
_SLACK_M, _SLACK_SHARE = 0.05, 0.05
"""A point is seen, not hidden, where the other depth is the same up to this and to this share."""


class DepthCamera(BaseModel):
    """What turns a depth image into points: pixels, and units of the image per metre."""

    fx: float = Field(gt=0.0)
    fy: float = Field(gt=0.0)
    cx: float
    cy: float
    depth_scale: float = Field(gt=0.0)


class _Summary(BaseModel):
    camera: DepthCamera


def camera_of_run(summary: Path) -> DepthCamera:
    """Return the camera that a run's summary.json names.

    Raises:
        LoopcloseError: the file cannot be read, or names none.
    """
    try:
        return _Summary.model_validate(read_json(summary)).camera
    except ValidationError as error:
        raise RecognizerError(f"no camera is named in it: {summary}") from error


def overlaps(
    recording: Path, dataset: PlaceDataset, camera: DepthCamera, pairs: NDArray[np.bool_]
) -> FloatArray:
    """Return (N, N), of what each image of a recording shows, which share each other one shows.

    The share counts what has depth in both; it is the mean of both ways. It is NaN for other pairs
    than those asked for, and where nothing has depth.

    Args:
        recording: folder in the format of TUM RGB-D, with a depth.txt.
        dataset: N images of it with their poses.
        camera: its own.
        pairs: (N, N) symmetric, those that are looked at.

    Raises:
        LoopcloseError: a list or a depth image cannot be read.
    """
    if dataset.timestamps_s is None or dataset.positions_m is None or dataset.quaternions is None:
        raise RecognizerError(f"{dataset.name} has no poses to place depth by")
    depths_m = _depth_images(recording, dataset.timestamps_s, camera)
    R = Rotation.from_quat(dataset.quaternions).as_matrix()
    shares = np.full(pairs.shape, np.nan)
    for i, depth_m in enumerate(depths_m):
        if depth_m is not None:
            points_m = _points(depth_m, camera) @ R[i].T + dataset.positions_m[i]
            for j in np.flatnonzero(pairs[i]).tolist():
                other_m = depths_m[j]
                if other_m is not None:
                    seen_m = (points_m - dataset.positions_m[j]) @ R[j]
                    shares[i, j] = _share_seen(seen_m, other_m, camera)
    return np.asarray((shares + shares.T) / 2.0)


def _depth_images(
    recording: Path, stamps_s: FloatArray, camera: DepthCamera
) -> Sequence[FloatArray | None]:
    """Return for each image one pixel of each cell of its depth image, metres, 0 where none."""
    times_s, paths = read_images(recording / "depth.txt", [])
    order = np.argsort(times_s, kind="stable")
    found = nearest(times_s[order], stamps_s)
    depths_m: list[FloatArray | None] = []
    for stamp_s, k in zip(stamps_s, order[found], strict=True):
        if abs(times_s[k] - stamp_s) > _MAX_TIME_DIFFERENCE_S:
            depths_m.append(None)
            continue
        image = decode(paths[k], cv2.IMREAD_UNCHANGED)
        if isinstance(image, BrokenImage) or image.ndim != 2:
            why = image.why if isinstance(image, BrokenImage) else "it has colours"
            raise RecognizerError(f"not a depth image: {why}: {paths[k]}")
        cells = image[_CELL_PX // 2 :: _CELL_PX, _CELL_PX // 2 :: _CELL_PX]
        depths_m.append(np.nan_to_num(cells.astype(np.float64)) / camera.depth_scale)
    return depths_m


def _points(depth_m: FloatArray, camera: DepthCamera) -> FloatArray:
    """Return the (P, 3) points, metres in the camera's frame, of the cells that have depth."""
    rows, columns = np.nonzero(depth_m > _NEAREST_M)
    z = depth_m[rows, columns]
    x = (_CELL_PX * (columns + 0.5) - camera.cx) / camera.fx * z
    y = (_CELL_PX * (rows + 0.5) - camera.cy) / camera.fy * z
    return np.column_stack([x, y, z])


def _share_seen(points_m: FloatArray, depth_m: FloatArray, camera: DepthCamera) -> float:
    """Return the share of (P, 3) points, in a camera's frame, that its depth image shows."""
    ahead = points_m[:, 2] > _NEAREST_M
    x, y, z = points_m[ahead].T
    columns = np.floor((camera.fx * x / z + camera.cx) / _CELL_PX)
    rows = np.floor((camera.fy * y / z + camera.cy) / _CELL_PX)
    inside = (rows >= 0) & (columns >= 0) & (rows < len(depth_m)) & (columns < depth_m.shape[1])
    z = z[inside]
    there_m = depth_m[rows[inside].astype(np.int64), columns[inside].astype(np.int64)]
    known = there_m > _NEAREST_M
    is_seen = np.abs(there_m - z)[known] < _SLACK_M + _SLACK_SHARE * z[known]
    count = len(points_m) - np.count_nonzero(~known)
    return float(np.count_nonzero(is_seen) / count) if count else float("nan")
