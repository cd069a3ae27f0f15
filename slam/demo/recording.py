# SPDX-License-Identifier: Apache-2.0
"""The demo sequence: a made-up room, driven round twice, as a TUM RGB-D folder with exact truth."""

import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from numpy.random import Generator

from slam.datasets.cameras import CAMERA_FILE, write_camera
from slam.demo.kinect_noise import add_colour_noise, add_kinect_noise
from slam.demo.room import Room, build_room, render
from slam.evaluation.trajectory import write_tum
from slam.types import Camera, FloatArray, SlamError, Trajectory

_DEMO_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)  # the benchmark's default pinhole

LAP_S = 12.0
FRAMES_PER_S = 15.0
"""Half a Kinect's rate: half the work, for a camera that moves 3 cm and 2 degrees a frame."""
_START_S = 100.0  # three digits throughout, so that file names sort in the order of time


def render_sequence(
    folder: Path,
    seconds: float = 2.0 * LAP_S + 0.5,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    camera: Camera = _DEMO_CAMERA,
    frames_per_s: float = FRAMES_PER_S,
    enlarged: float = 1.0,
) -> None:
    """Write a complete TUM RGB-D folder, camera.toml included, or nothing at all.

    Args:
        folder: must not exist yet, or be empty.
        seconds: length; the default is two laps and a little more.
        seed: of the room, the camera's shake and the noise; the same seed gives the same bytes.
        progress: called with (frames done, frames in all).
        camera: what to render with.
        frames_per_s: how often it takes an image.
        enlarged: how many times larger room and walk are, for the same sensor: the colours stay,
            and depth is seen as far as before.

    Raises:
        LoopcloseError: the folder is not empty or cannot be written.
    """
    times_s = np.arange(max(1, round(seconds * frames_per_s))) / frames_per_s
    path = Trajectory(times_s + _START_S, drive(times_s, seed))
    render_path(folder, build_room(seed), path, seed, progress, camera, enlarged)


def render_path(
    folder: Path,
    room: Room,
    path: Trajectory,
    seed: int = 0,
    progress: Callable[[int, int], None] | None = None,
    camera: Camera = _DEMO_CAMERA,
    enlarged: float = 1.0,
) -> None:
    """Write what a camera sees on its way through a room, as `render_sequence` does.

    Raises:
        LoopcloseError: the folder is not empty or cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SlamError(f"there is something already; choose another folder or remove it: {folder}")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".rendering-") as scratch:
            unfinished = Path(scratch) / folder.name
            photograph = partial(_photograph, room, camera, enlarged)
            _write_images(unfinished, path, photograph, seed, progress or (lambda *_: None))
            write_tum(unfinished / "groundtruth.txt", path.enlarged(enlarged))
            write_camera(unfinished / CAMERA_FILE, camera)
            unfinished.replace(folder)
    except OSError as error:
        raise SlamError(
            f"cannot write the rendered sequence: {error.strerror}: {folder}"
        ) from error


def _write_images(
    folder: Path,
    path: Trajectory,
    photograph: Callable[[FloatArray, Generator], tuple[bytes, bytes]],
    seed: int,
    progress: Callable[[int, int], None],
) -> None:
    count = len(path)
    stamps = [f"{time_s:.6f}" for time_s in path.timestamps_s]
    for name, kind in (("rgb", "jpg"), ("depth", "png")):
        (folder / name).mkdir(parents=True)
        lines = [f"{stamp} {name}/{stamp}.{kind}\n" for stamp in stamps]
        (folder / f"{name}.txt").write_text("# timestamp filename\n" + "".join(lines))
    # Noise belongs to the frame, not to the order in which threads happen to render.
    rngs = [np.random.default_rng([seed, 0xF0, index]) for index in range(count)]
    pool = ThreadPoolExecutor(4)
    try:
        for index, (jpeg, png) in enumerate(pool.map(photograph, path.T_world_cam, rngs)):
            (folder / f"rgb/{stamps[index]}.jpg").write_bytes(jpeg)
            (folder / f"depth/{stamps[index]}.png").write_bytes(png)
            progress(index + 1, count)
    finally:
        pool.shutdown(cancel_futures=True)


def _photograph(
    room: Room, camera: Camera, enlarged: float, T_room_cam: FloatArray, rng: Generator
) -> tuple[bytes, bytes]:
    """Return the colours as JPEG and the depth as 16-bit PNG, both with a Kinect's noise."""
    perfect = render(room, camera, T_room_cam)
    rgb = add_colour_noise(perfect.rgb, rng)
    depth_m = add_kinect_noise(np.float32(enlarged) * perfect.depth_m, camera, rng)
    depth = np.rint(depth_m * camera.depth_scale).astype(np.uint16)
    jpeg = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 92])[1]
    png = cv2.imencode(".png", depth, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
    return jpeg.tobytes(), png.tobytes()


def drive(times_s: FloatArray, seed: int) -> FloatArray:
    """Return (N, 4, 4) T_world_cam of a hand-held camera walking ellipses about the origin.

    It walks some 0.4 m/s and turns some 30 degrees a second. The second lap runs 8 cm further out
    and 3 cm higher, and looks 6 degrees further ahead.
    """
    laps = times_s / LAP_S
    around = 2.0 * np.pi * laps
    ramp = np.clip((laps - 0.85) / 0.3, 0.0, 1.0)
    second = ramp * ramp * (3.0 - 2.0 * ramp)
    rng = np.random.default_rng([seed, 0xD21])
    hertz = rng.uniform(0.4, 1.8, (6, 4, 1))
    phase = rng.uniform(0.0, 2.0 * np.pi, (6, 4, 1))
    shake = 0.0035 * (np.sin(2.0 * np.pi * hertz * times_s + phase) / hertz).sum(axis=1)
    # The view is turned by 1.1 rad from straight outwards to the direction of travel.
    yaw = around + 1.1 + 0.1 * second + 0.08 * np.sin(2.3 * around)
    pitch = -0.12 + 0.06 * np.sin(1.3 * around)
    x_m, y_m = (0.8 + 0.08 * second) * np.cos(around), (0.6 + 0.08 * second) * np.sin(around)
    z_m = 1.3 + 0.03 * second + 0.05 * np.sin(1.7 * around)
    T_world_cam = np.tile(np.eye(4), (len(times_s), 1, 1))
    T_world_cam[:, :3, :3] = _looking(yaw + shake[0], pitch + shake[1], shake[2])
    T_world_cam[:, :3, 3] = np.stack([x_m, y_m, z_m], axis=-1) + 0.5 * shake[3:].T
    return T_world_cam


def _looking(yaw: FloatArray, pitch: FloatArray, roll: FloatArray) -> FloatArray:
    """Return (N, 3, 3) R_world_cam: z forward, y down, world z up; angles in rad."""
    forward = np.stack(
        [np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], axis=-1
    )
    level = np.stack([np.sin(yaw), -np.cos(yaw), np.zeros_like(yaw)], axis=-1)
    below = np.cross(forward, level)
    c, s = np.cos(roll)[:, None], np.sin(roll)[:, None]
    return np.stack([c * level + s * below, c * below - s * level, forward], axis=-1)
