# SPDX-License-Identifier: Apache-2.0
"""Meshes made by a process of their own: what Open3D takes is given back with it."""

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from placerec.files import arrays_of
from slam.config import MapConfig
from slam.geometry import se3
from slam.geometry.features import distort
from slam.geometry.reprojection import pinhole
from slam.output.point_cloud import sizes
from slam.result import MapMesh, MapMeshes, SlamResult
from slam.types import PREVIEW_SCALE, Camera, FloatArray, IntArray, Keyframe, SlamError

MESHES = ("mesh_before.ply", "mesh_after.ply")


def meshes_apart(folder: Path, result: SlamResult, config: MapConfig) -> MapMeshes:
    """Write the keyframes' surfaces along the path of odometry and along the corrected one.

    Where no loop was closed, there is only the latter.

    Raises:
        SlamError: there is no depth, a file cannot be written, or the process was ended.
    """
    keyframes, paths = _paths(result)
    if not keyframes:
        raise SlamError("no keyframe is on both paths")
    voxel_m, max_depth_m = sizes(result, config)
    shrunk = PREVIEW_SCALE * np.array(pinhole(result.camera))
    files = [str(folder / name) for name in MESHES[-len(paths) :]]
    shape = result.camera.preview_shape
    told = json.dumps([files, len(keyframes), shape, shrunk.tolist(), voxel_m, max_depth_m])
    with tempfile.TemporaryFile() as complaints:
        answer, code = _asked(told, _sent(keyframes, paths, result.camera), complaints)
        complaints.seek(0)
        said = complaints.read().decode("utf-8", "replace").strip()
    if code < 0:
        raise SlamError(f"the process that makes them was ended by {signal.Signals(-code).name}")
    if code:
        raise SlamError(said.splitlines()[-1].strip() if said else f"exit code {code}")
    found = arrays_of(answer)
    *before, after = [
        MapMesh(
            float(found["entropies"][i]),
            float(found["off_planes_m"][i]),
            found["overviews"][i],
            found["closer"][i],
        )
        for i in range(len(files))
    ]
    number = keyframes[int(found["keyframe"])].id
    return MapMeshes(before[0] if before else None, after, number)


def _paths(result: SlamResult) -> tuple[list[Keyframe], list[FloatArray]]:
    """Return the keyframes with a place, and (K, 4, 4) where they are along each path, the world.

    Both begin at the same pose: one from elsewhere comes in a frame of its own.
    """
    odometry = result.odometry
    stamps_s = np.array([each.timestamp_s for each in result.keyframes])
    has_place = np.isfinite(result.T_world_kf[:, 0, 0])
    if all(attempt.rejection for attempt in result.attempts):
        paths = [result.T_world_kf]
    else:
        has_place &= np.isin(stamps_s, odometry.timestamps_s)
        rows = np.searchsorted(odometry.timestamps_s, stamps_s).clip(0, len(odometry) - 1)
        paths = [odometry.T_world_cam[rows], result.T_world_kf]
    placed = [
        each for each, is_placed in zip(result.keyframes, has_place, strict=True) if is_placed
    ]
    *before, after = [path[has_place] for path in paths]
    before = [after[:1] @ se3.inverse(path[:1]) @ path for path in before]
    return placed, [*before, after]


def _asked(told: str, images: Iterator[NDArray[Any]], complaints: IO[bytes]) -> tuple[bytes, int]:
    """Return what the process answers to the images, and its exit code or minus its signal."""
    code = "from slam.output.mesh.before_and_after import main; main()"
    paths = os.pathsep.join(path for path in sys.path if path)
    fusing = subprocess.Popen(
        [sys.executable, "-c", code, told],
        env=os.environ | {"PYTHONPATH": paths, "PYTHONIOENCODING": "utf-8:backslashreplace"},
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=complaints,
        process_group=0,  # a terminal's Ctrl-C comes here only, and ends it below
    )
    assert fusing.stdin is not None and fusing.stdout is not None
    with fusing:
        try:
            with suppress(BrokenPipeError), fusing.stdin as stream:  # its exit code says why
                for each in images:
                    stream.write(each.tobytes())
            answer = fusing.stdout.read()
            return answer, fusing.wait()
        except BaseException:
            fusing.kill()  # it writes files whole or not at all
            raise


def _sent(
    keyframes: Sequence[Keyframe], paths: Sequence[FloatArray], camera: Camera
) -> Iterator[NDArray[Any]]:
    """Yield of each path each keyframe's pose, colour and depth, as an ideal pinhole sees them.

    It is that of the run's camera, whatever took a keyframe.
    """
    cameras = {each.camera or camera for each in keyframes}
    straight = {each: straight_pixels(camera, each) for each in cameras}
    for path in paths:
        for keyframe, T_world_cam in zip(keyframes, path, strict=True):
            shown = keyframe.preview
            rows, columns, is_outside = straight[keyframe.camera or camera]
            depth_m = shown.depth_m[rows, columns]
            depth_m[is_outside] = 0.0
            yield from (T_world_cam, shown.rgb[rows, columns], depth_m)


def straight_pixels(
    camera: Camera, taken_by: Camera
) -> tuple[IntArray, IntArray, NDArray[np.bool_]]:
    """Return for each pixel of a camera's straight preview where that of another one shows it.

    The mask says which ones it does not show.
    """
    shape, (height, width) = camera.preview_shape, taken_by.preview_shape
    v, u = np.mgrid[: shape[0], : shape[1]].reshape(2, -1) / PREVIEW_SCALE
    if taken_by != camera:
        u = (u - camera.cx) * (taken_by.fx / camera.fx) + taken_by.cx
        v = (v - camera.cy) * (taken_by.fy / camera.fy) + taken_by.cy
    seen = PREVIEW_SCALE * distort(np.column_stack([u, v]), taken_by)
    columns, rows = np.rint(seen).astype(np.int64).T.reshape(2, *shape)
    is_outside = (rows < 0) | (rows >= height) | (columns < 0) | (columns >= width)
    return rows.clip(0, height - 1), columns.clip(0, width - 1), is_outside
