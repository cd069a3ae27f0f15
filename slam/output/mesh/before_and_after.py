# SPDX-License-Identifier: Apache-2.0
"""The process that makes meshes of the images it is sent, and tells how sharp the maps are."""

import json
import math
import os
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from placerec.errors import cause_of, terminations_interrupt
from slam.geometry import se3
from slam.output.mesh.fusion import Fusion, Mesh, write_mesh
from slam.output.mesh.sharpness import Surroundings, surroundings
from slam.output.mesh.views import closer, overview
from slam.types import FloatArray, IntArray, SlamError

_MOST_POINTS, _EACH = 120_000, 4  # that sharpness is told from; about each so many-th is asked
_RADIUS = 10.0  # voxels, within which points are neighbours
_FEWEST = 20  # points of a keyframe that say where the maps differ


@dataclass(frozen=True)
class _Map:
    """One map: its surface, and (N, 3) points with the (N,) keyframes that measured them."""

    mesh: Mesh
    points_m: FloatArray
    seen_by: IntArray
    T_world_cam: FloatArray

    def distance_m(self, number: int) -> float:
        """Return how far a keyframe's points usually are, 1 m if it has none."""
        seen_m = self.points_m[self.seen_by == number] - self.T_world_cam[number, :3, 3]
        return float(np.median(seen_m @ self.T_world_cam[number, :3, 2])) if len(seen_m) else 1.0


@dataclass(frozen=True)
class Asked:
    """What is asked for, as the command line tells it.

    Attributes:
        files: the mesh of each path is written to.
        keyframes: how many images follow for each path.
        shape: height and width of an image.
        pinhole: fx, fy, cx, cy.
        voxel_m, max_depth_m: how fine, and how far from the camera.
    """

    files: list[str]
    keyframes: int
    shape: list[int]
    pinhole: list[float]
    voxel_m: float
    max_depth_m: float


def main() -> None:
    """Write the meshes that the command line names, of images from stdin; answer on stdout."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what libraries print is no answer
    with suppress(OSError):  # where memory ends, this process goes, and not the run
        Path("/proc/self/oom_score_adj").write_text("1000")
    with terminations_interrupt():
        try:
            found = made(Asked(*json.loads(sys.argv[1])), sys.stdin.buffer)
            with answers:
                np.savez(answers, allow_pickle=False, **found)
        except KeyboardInterrupt:
            sys.exit("interrupted")
        except Exception as error:
            sys.exit(cause_of(error))  # the last line is what the other process looks at


def made(asked: Asked, images: IO[bytes]) -> dict[str, NDArray[Any]]:
    """Write the meshes of the images, and return how sharp they are and how they look.

    Raises:
        LoopcloseError: there is no depth, or a file cannot be written.
    """
    maps = [_fused(asked, images) for _ in asked.files]
    for each, path in zip(maps, asked.files, strict=True):
        if not len(each.mesh.triangles):
            raise SlamError("no surface was seen by two keyframes with depth")
        write_mesh(Path(path), each.mesh)
    chosen = np.arange(0, len(maps[0].points_m), _EACH)
    radius_m = _RADIUS * asked.voxel_m
    about = [surroundings(each.points_m, chosen, radius_m) for each in maps]
    # The same points in both, or a map would be the sharper for what it lost.
    known = np.isfinite(np.sum([each.entropies for each in about], axis=0))
    keyframe = _differs_most(about, known, maps[0].seen_by[chosen])
    above = [overview(each.mesh, maps[-1].T_world_cam) for each in maps]
    distance_m = maps[0].distance_m(keyframe)
    near = [closer(each.mesh, each.T_world_cam[keyframe], distance_m) for each in maps]
    return {
        "entropies": np.array([_mean(each.entropies[known]) for each in about]),
        "off_planes_m": np.array([_mean(each.plane_variances_m2[known]) ** 0.5 for each in about]),
        "keyframe": np.array(keyframe),
        "overviews": np.array(above),
        "closer": np.array(near),
    }


def _fused(asked: Asked, images: IO[bytes]) -> _Map:
    """Return the map of the next so many images."""
    fusion = Fusion(np.array(asked.pinhole), asked.voxel_m, asked.max_depth_m)
    points_m, seen_by, poses = [], [], []
    for number in range(asked.keyframes):
        T_world_cam = _read(images, np.float64, 4, 4)
        rgb = _read(images, np.uint8, *asked.shape, 3)
        depth_m = _read(images, np.float32, *asked.shape)
        fusion.add(rgb, depth_m, T_world_cam)
        stride = max(1, int(np.ceil((asked.keyframes * depth_m.size / _MOST_POINTS) ** 0.5)))
        seen_m = _points(depth_m, stride, asked)
        points_m.append(se3.transform(T_world_cam, seen_m))
        seen_by.append(np.full(len(seen_m), number))
        poses.append(T_world_cam)
    return _Map(fusion.mesh(), np.concatenate(points_m), np.concatenate(seen_by), np.array(poses))


def _read(images: IO[bytes], kind: type[Any], *shape: int) -> NDArray[Any]:
    count = math.prod(shape) * np.dtype(kind).itemsize
    return np.frombuffer(images.read(count), kind).reshape(shape)


def _points(depth_m: NDArray[np.float32], stride: int, asked: Asked) -> FloatArray:
    """Return (N, 3) of a keyframe's points, its own frame."""
    fx, fy, cx, cy = asked.pinhole
    height, width = depth_m.shape
    v, u = np.mgrid[stride // 2 : height : stride, stride // 2 : width : stride]
    z = depth_m[v, u].astype(np.float64)
    seen = (z > 0.0) & (z <= asked.max_depth_m)
    return np.column_stack([axis[seen] for axis in ((u - cx) / fx * z, (v - cy) / fy * z, z)])


def _mean(values: FloatArray) -> float:
    return float(values.mean()) if len(values) else np.nan


def _differs_most(about: list[Surroundings], known: NDArray[np.bool_], seen_by: IntArray) -> int:
    """Return the keyframe whose points' surroundings differ most between the maps."""
    apart = about[0].entropies[known] - about[-1].entropies[known]
    counts = np.bincount(seen_by[known])
    sums = np.bincount(seen_by[known], apart)
    means = np.abs(sums) / np.maximum(counts, _FEWEST)
    return int(np.argmax(means)) if len(means) else 0
