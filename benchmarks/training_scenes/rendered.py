# SPDX-License-Identifier: Apache-2.0
"""Rendered rooms and cluttered tables, their surfaces partly papered with photographs.

In each scene there are some places, near each other, and some views of each: whoever learns from
them gets hard negatives without looking for them.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from benchmarks.training_scenes.desk_scene import TABLE_HEIGHT_M, cluttered_table, table_size
from benchmarks.training_scenes.folder import Image, Views, as_cheap_cameras_see
from benchmarks.training_scenes.poses import (
    PATH_S,
    PATH_VIEWS,
    distance,
    nudged,
    path_times_s,
    pose,
    swing,
)
from slam import Camera
from slam.demo.layout import furnished_room
from slam.demo.panels import Panel, light
from slam.demo.room import LAMPS_M, ROOM_SIZE_M, Room, assemble, render
from slam.types import FloatArray

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 192, 144, 157.0
PLACES, VIEWS = 36, 6
RADIUS = 0.33
"""Largest distance (eq. 10: metres plus radians) of a view from the middle of its place."""
APART, NEARBY = 0.8, 1.5
"""Least distance of two places, and the largest of most of them to some other."""
SECONDS_APART = 4.0
"""Between two views, so that none is left out for following the last too soon."""
PHOTOGRAPHED, SMALLEST_TEXELS = 0.4, 24
LEAST_CONTRAST = 20.0
WORKERS = 2


@dataclass(frozen=True)
class Scene:
    """Something to look at, and from where it can be seen."""

    room: Room
    table_m: tuple[float, float] | None
    """Width and depth of the table in the middle; None for a room with its middle free."""

    def aim(self, rng: np.random.Generator) -> FloatArray:
        """Return a random (4, 4) T_world_cam that looks at something."""
        roll_rad = np.radians(np.clip(rng.normal(0.0, 9.0), -30.0, 30.0))
        yaw_rad = rng.uniform(-np.pi, np.pi)
        if self.table_m is None:
            position_m = rng.uniform((-1.5, -1.05, 0.8), (1.5, 1.05, 1.9))
            return pose(position_m, yaw_rad, np.radians(rng.uniform(-40.0, 12.0)), roll_rad)
        width_m, depth_m = self.table_m
        target_m = rng.uniform(-0.45, 0.45, 3) * (depth_m, width_m, 0.5)
        target_m[2] += TABLE_HEIGHT_M + 0.12
        pitch_rad = -np.radians(rng.uniform(5.0, 60.0))
        return self.orbit(target_m, rng.uniform(0.55, 1.9), yaw_rad, pitch_rad, roll_rad)

    @staticmethod
    def orbit(
        target_m: FloatArray, distance_m: float, yaw_rad: float, pitch_rad: float, roll_rad: float
    ) -> FloatArray:
        """Return the (4, 4) T_world_cam that has a target before it."""
        T = pose(target_m, yaw_rad, pitch_rad, roll_rad)
        T[:3, 3] -= distance_m * T[:3, 2]
        return T

    def allows(self, T_world_cam: FloatArray) -> bool:
        """Return whether a camera can be there and has something before it."""
        x, y, z = T_world_cam[:3, 3]
        if self.table_m is None:
            return bool(abs(x) < 1.6 and abs(y) < 1.15 and 0.6 < z < 2.1)
        reach = np.array(self.table_m)[::-1] / 2
        ahead = T_world_cam[:3, 3] + T_world_cam[:3, 2]
        target = np.append(np.clip(ahead[:2], -reach, reach), TABLE_HEIGHT_M + 0.1)
        towards = target - T_world_cam[:3, 3]
        is_seen = T_world_cam[:3, 2] @ towards > 0.75 * np.linalg.norm(towards)
        is_upright = -T_world_cam[2, 1] > 0.7 * np.hypot(T_world_cam[2, 1], T_world_cam[2, 0])
        is_free = z > TABLE_HEIGHT_M + 0.25 or (np.abs((x, y)) > reach + 0.15).any()
        return bool(
            is_seen and is_upright and is_free and max(abs(x), abs(y)) < 1.5 and 0.5 < z < 2.3
        )


def build_scene(kind: str, seed: int, photographs: Sequence[Image]) -> Scene:
    """Return a room or a desk, its surfaces partly papered with photographs."""
    rng = np.random.default_rng([seed, 0x5CE])
    table_m = table_size(rng) if kind == "desk" else None
    panels = cluttered_table(rng, *table_m) if table_m else furnished_room(rng, *ROOM_SIZE_M)
    if photographs and rng.random() < 0.7:
        panels = papered(panels, photographs, PHOTOGRAPHED, rng)
    lamps_m = LAMPS_M if table_m is None else rng.uniform((-2, -2, 1.6), (2, 2, 2.4), (3, 3))
    return Scene(assemble(light(panels, lamps_m, rng)), table_m)


def papered(
    panels: Sequence[Panel],
    photographs: Sequence[Image],
    share: float,
    rng: np.random.Generator,
) -> list[Panel]:
    """Return the panels, some of them showing a piece of a photograph instead.

    Args:
        panels: not yet lit; those too small to show anything are left as they are.
        photographs: (h, w, 3) uint8 RGB each.
        share: of the panels that get one.
        rng: chooses panels, photographs and pieces.
    """
    return [
        replace(panel, texture=_piece(photographs[int(rng.integers(len(photographs)))], panel, rng))
        if min(panel.texture.shape[:2]) >= SMALLEST_TEXELS and rng.random() < share
        else panel
        for panel in panels
    ]


def _piece(photograph: Image, panel: Panel, rng: np.random.Generator) -> Image:
    """Return a piece of the panel's shape, a quarter to all of the photograph, maybe mirrored."""
    height, width = panel.texture.shape[:2]
    rows, columns = photograph.shape[:2]
    scale = rng.uniform(0.25, 1.0) * min(columns / width, rows / height)
    w, h = max(1, int(width * scale)), max(1, int(height * scale))
    left, top = rng.integers(columns - w + 1), rng.integers(rows - h + 1)
    piece = photograph[top : top + h, left : left + w]
    if rng.random() < 0.5:
        piece = piece[:, ::-1]
    how = cv2.INTER_AREA if w > width else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(np.ascontiguousarray(piece), (width, height), interpolation=how))


def views_of_places(scene: Scene, rng: np.random.Generator) -> list[FloatArray]:
    """Return poses of some views of each of some places, most of them near another."""
    places: list[FloatArray] = []
    for _ in range(3000):
        is_near = bool(places) and rng.random() < 0.8
        T = nudged(places[rng.integers(len(places))], NEARBY, rng) if is_near else scene.aim(rng)
        if scene.allows(T) and all(distance(T, other) > APART for other in places):
            places.append(T)
        if len(places) == PLACES:
            break
    views = [nudged(place, RADIUS, rng) for place in places for _ in range(VIEWS)]
    return [T for T in views if scene.allows(T)]


def path(scene: Scene, rng: np.random.Generator) -> list[FloatArray]:
    """Return poses of a camera carried around in a scene, coming back now and then."""
    to_and_fro = partial(swing, path_times_s(), rng)
    yaw_rad = rng.uniform(-np.pi, np.pi) + to_and_fro(1.2)
    roll_rad = to_and_fro(0.25, 1.2)
    if scene.table_m is None:
        x_m = rng.uniform(-0.6, 0.6) + to_and_fro(0.7)
        y_m = rng.uniform(-0.4, 0.4) + to_and_fro(0.6)
        positions_m = np.stack([x_m, y_m, 1.3 + to_and_fro(0.3)], axis=1)
        angles = zip(positions_m, yaw_rad, -0.31 + to_and_fro(0.3), roll_rad, strict=True)
        return [pose(*at) for at in angles]
    width_m, depth_m = scene.table_m
    height_m = np.full(PATH_VIEWS, TABLE_HEIGHT_M + 0.1)
    targets_m = np.stack([to_and_fro(0.45 * depth_m), to_and_fro(0.45 * width_m), height_m], axis=1)
    distances_m, pitch_rad = 1.1 + to_and_fro(0.4), -0.49 + to_and_fro(0.35)
    angles = zip(targets_m, distances_m, yaw_rad, pitch_rad, roll_rad, strict=True)
    return [scene.orbit(*at) for at in angles]


def photographed(scene: Scene, T_world_cam: FloatArray, rng: np.random.Generator) -> Image:
    """Return a view as a cheap camera would take it: exposure, tint, blur, noise."""
    focal_px = FOCAL_PX * np.exp(rng.uniform(-0.12, 0.12))
    centre_px = (WIDTH_PX / 2 - 0.5, HEIGHT_PX / 2 - 0.5)
    camera = Camera(WIDTH_PX, HEIGHT_PX, focal_px, focal_px, *centre_px)
    return as_cheap_cameras_see(render(scene.room, camera, T_world_cam).rgb, rng)


def views(kind: str, seed: int, photographs: Sequence[Image], paths: bool) -> Views:
    """Yield a scene's views, bare walls left out."""
    scene, rng = build_scene(kind, seed, photographs), np.random.default_rng([seed, 0x71E])
    poses = path(scene, rng) if paths else views_of_places(scene, rng)
    pause_s = PATH_S / PATH_VIEWS if paths else SECONDS_APART
    rngs = [np.random.default_rng([seed, 0xF17, number]) for number in range(len(poses))]
    with ThreadPoolExecutor(WORKERS) as pool:
        images = list(pool.map(partial(photographed, scene), poses, rngs))
    for number, (image, T_world_cam) in enumerate(zip(images, poses, strict=True)):
        if image[::4, ::4].std() >= LEAST_CONTRAST:  # nobody could tell a bare wall from another
            yield 100.0 + number * pause_s, image, T_world_cam
