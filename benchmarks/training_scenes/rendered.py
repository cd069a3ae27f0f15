# SPDX-License-Identifier: Apache-2.0
"""Rendered rooms and cluttered tables, their surfaces partly papered with photographs.

In each scene there are some places, near each other, and some views of each: whoever learns from
them gets hard negatives without looking for them.
"""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from benchmarks.training_scenes.handheld import (
    PATH_S,
    PATH_VIEWS,
    Image,
    Views,
    as_cheap_cameras_see,
    nudged,
    path_times_s,
    pose,
    swing,
)
from slam import Camera, Trajectory
from slam.demo import furniture, textures, wall_pictures
from slam.demo.layout import furnished_room, wall_frame
from slam.demo.panels import Panel, Point, box, light, panel, turned
from slam.demo.recording import render_path
from slam.demo.room import LAMPS_M, ROOM_SIZE_M, Room, assemble, render
from slam.demo.textures import Material, colour_of
from slam.geometry.se3 import from_rotation_translation, pose_distance
from slam.types import FloatArray

TABLE_HEIGHT_M = 0.74
_CEILING_M = 2.6
_WALL_M = 6.0
_APART_M = 0.13

_FRONTS: tuple[Material, ...] = (
    wall_pictures.abstract,
    wall_pictures.contours,
    wall_pictures.framed,
    wall_pictures.screen,
    wall_pictures.spine,
)
_COVERS = (textures.plaster, textures.cloth, textures.wood, textures.panelling)


def table_size(rng: np.random.Generator) -> tuple[float, float]:
    """Return a random width and depth of a table, metres."""
    return float(rng.uniform(1.4, 3.2)), float(rng.uniform(0.8, 2.0))


def cluttered_table(rng: np.random.Generator, width_m: float, depth_m: float) -> list[Panel]:
    """Return the panels of a table full of things, and of what stands and hangs around it.

    The floor is z = 0 and the table's middle above the origin; its width is along y.
    """
    R_world_table = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    T = from_rotation_translation(R_world_table, np.zeros(3))
    size = (width_m, 0.04, depth_m)
    panels = box(T, (-width_m / 2, TABLE_HEIGHT_M - 0.04, -depth_m / 2), size, rng, _cover(rng))
    panels += _floor_and_ceiling(rng, T)
    for side in range(4):
        distance_m = float(rng.uniform(1.6, 3.0))
        panels += _wall(rng, wall_frame(side * np.pi / 2, distance_m))
    return panels + _things(rng, T, width_m, depth_m)


def _floor_and_ceiling(rng: np.random.Generator, T: FloatArray) -> list[Panel]:
    material = textures.planks if rng.random() < 0.5 else textures.cloth
    floor = material(rng, _WALL_M, _WALL_M, colour_of(rng, 40, 200))
    ceiling = textures.plaster(rng, _WALL_M, _WALL_M, (215.0, 213.0, 205.0))
    half, across = _WALL_M / 2, (_WALL_M, 0.0, 0.0)
    return [
        panel(T, (-half, 0.0, half), across, (0.0, 0.0, -_WALL_M), floor),
        panel(T, (-half, _CEILING_M, -half), across, (0.0, 0.0, _WALL_M), ceiling),
    ]


def _wall(rng: np.random.Generator, T: FloatArray) -> list[Panel]:
    """Return a wall with some pictures on it and some boxy furniture before it."""
    materials = (textures.plaster, textures.bricks, textures.wallpaper)
    colour = colour_of(rng, 60, 230)
    texture = materials[int(rng.integers(len(materials)))](rng, _WALL_M, _CEILING_M, colour)
    across, down = (_WALL_M, 0.0, 0.0), (0.0, -_CEILING_M, 0.0)
    panels = [panel(T, (-_WALL_M / 2, _CEILING_M, 0.0), across, down, texture)]
    for _ in range(int(rng.integers(1, 7))):
        centre = (float(rng.uniform(-2.2, 2.2)), float(rng.uniform(0.6, 1.9)), 0.0)
        width_m, height_m = rng.uniform(0.2, 1.0, 2)
        panels += furniture.picture(T, centre, width_m, height_m, rng, _front(rng))
    for _ in range(int(rng.integers(0, 4))):
        w, h, d = rng.uniform((0.3, 0.4, 0.2), (1.2, 1.8, 0.6))
        x = float(rng.uniform(-2.0, 2.0))
        panels += box(T, (x - w / 2, 0.0, 0.0), (w, h, d), rng, _cover(rng), _front(rng))
    return panels


def _things(rng: np.random.Generator, T: FloatArray, width_m: float, depth_m: float) -> list[Panel]:
    panels: list[Panel] = []
    spots: list[tuple[float, float]] = []
    reach = np.array([width_m, depth_m]) / 2 - 0.08
    for _ in range(int(rng.integers(30, 75))):
        for _ in range(20):  # a free spot, where there is one
            x, z = rng.uniform(-reach, reach)
            if all(abs(x - a) + abs(z - b) > _APART_M for a, b in spots):
                break
        spots.append((float(x), float(z)))
        stand = turned(T, (float(x), TABLE_HEIGHT_M, float(z)), rng.uniform(-180, 180))
        panels += _thing(rng, stand)
    return panels


def _thing(rng: np.random.Generator, T: FloatArray) -> list[Panel]:
    """Return a sheet or keyboard, a screen, a parcel or a tin: boxes, closed at the back."""
    kinds: tuple[tuple[float, Point, Point], ...] = (
        (0.25, (0.15, 0.004, 0.12), (0.45, 0.03, 0.35)),
        (0.17, (0.3, 0.25, 0.04), (0.6, 0.45, 0.3)),
        (0.38, (0.05, 0.04, 0.05), (0.25, 0.28, 0.25)),
        (0.2, (0.03, 0.08, 0.03), (0.08, 0.25, 0.08)),
    )
    _, least, most = kinds[rng.choice(len(kinds), p=[share for share, _, _ in kinds])]
    w, h, d = rng.uniform(least, most)
    front = _front(rng) if rng.random() < 0.6 else None
    panels = box(T, (-w / 2, 0.0, -d / 2), (w, h, d), rng, _cover(rng), front)
    back = _cover(rng)(rng, w, h)
    return [*panels, panel(T, (w / 2, h, -d / 2), (-w, 0.0, 0.0), (0.0, -h, 0.0), back)]


def _cover(rng: np.random.Generator) -> Material:
    kind = _COVERS[int(rng.integers(len(_COVERS)))]
    return partial(kind, colour=colour_of(rng, 20, 235))


def _front(rng: np.random.Generator) -> Material:
    return _FRONTS[int(rng.integers(len(_FRONTS)))]


WIDTH_PX, HEIGHT_PX, FOCAL_PX = 192, 144, 157.0
PLACES, VIEWS = 24, 10
RADIUS = 0.5
"""Largest distance (eq. 10: metres plus radians) of a view from the middle of its place: of the
pairs within one some are just beyond the limit, and most of the others not far from it."""
APART, NEARBY = 0.8, 1.5
"""Least distance of two places, and the largest of most of them to some other."""
START_S = 100.0
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


def views_of_places(scene: Scene, rng: np.random.Generator) -> list[tuple[FloatArray, int | None]]:
    """Return poses of some views of each of some places, most of them near another."""
    places: list[FloatArray] = []
    for _ in range(3000):
        is_near = bool(places) and rng.random() < 0.8
        T = nudged(places[rng.integers(len(places))], NEARBY, rng) if is_near else scene.aim(rng)
        if scene.allows(T) and all(pose_distance(T, other) > APART for other in places):
            places.append(T)
        if len(places) == PLACES:
            break
    views = [(nudged(T, RADIUS, rng), k) for k, T in enumerate(places) for _ in range(VIEWS)]
    return [(T, place) for T, place in views if scene.allows(T)]


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
    orbits = zip(targets_m, distances_m, yaw_rad, pitch_rad, roll_rad, strict=True)
    return [scene.orbit(*at) for at in orbits]


def photographed(scene: Scene, T_world_cam: FloatArray, rng: np.random.Generator) -> Image:
    """Return a view as a cheap camera would take it: exposure, tint, blur, noise."""
    focal_px = FOCAL_PX * np.exp(rng.uniform(-0.12, 0.12))
    centre_px = (WIDTH_PX / 2 - 0.5, HEIGHT_PX / 2 - 0.5)
    camera = Camera(WIDTH_PX, HEIGHT_PX, focal_px, focal_px, *centre_px)
    return as_cheap_cameras_see(render(scene.room, camera, T_world_cam).rgb, rng)


def views(kind: str, seed: int, photographs: Sequence[Image], paths: bool) -> Views:
    """Yield a scene's views, bare walls left out."""
    scene, rng = build_scene(kind, seed, photographs), np.random.default_rng([seed, 0x71E])
    seen = [(T, None) for T in path(scene, rng)] if paths else views_of_places(scene, rng)
    pause_s = PATH_S / PATH_VIEWS if paths else SECONDS_APART
    rngs = [np.random.default_rng([seed, 0xF17, number]) for number in range(len(seen))]
    with ThreadPoolExecutor(WORKERS) as pool:
        images = list(pool.map(partial(photographed, scene), (T for T, _ in seen), rngs))
    for number, (image, (T_world_cam, place)) in enumerate(zip(images, seen, strict=True)):
        if image[::4, ::4].std() >= LEAST_CONTRAST:  # nobody could tell a bare wall from another
            yield START_S + number * pause_s, image, T_world_cam, place


def record_path(folder: Path, kind: str, seed: int, photographs: Sequence[Image]) -> None:
    """Write what a Kinect sees on its path through a scene: colours, depth and true poses."""
    scene, rng = build_scene(kind, seed, photographs), np.random.default_rng([seed, 0x71E])
    poses = Trajectory(START_S + path_times_s(), np.array(path(scene, rng)))
    render_path(folder, scene.room, poses, seed)
