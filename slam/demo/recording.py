# SPDX-License-Identifier: Apache-2.0
"""The demo sequence: a made-up room, driven round twice, as a TUM RGB-D folder with exact truth."""

import tempfile
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from placerec.files import Progress
from slam.datasets.cameras import CAMERA_FILE, write_camera
from slam.demo.drive import LAP_S, drive
from slam.demo.kinect_noise import add_colour_noise, add_kinect_noise
from slam.demo.room import Room, build_room, render
from slam.evaluation.trajectory import write_tum
from slam.types import Camera, FloatArray, SlamError, Trajectory

_DEMO_CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
"""The benchmark's default pinhole camera, without distortion."""

FRAMES_PER_S = 15.0
"""Half a Kinect's rate: half the work, for a camera that moves 3 cm and 2 degrees a frame."""
_START_S = 100.0  # three digits throughout, so that file names sort in the order of time
_JPEG_QUALITY = 92
_WORKERS = 4


def render_sequence(
    folder: Path,
    seconds: float = 2.0 * LAP_S + 0.5,
    seed: int = 0,
    progress: Progress | None = None,
    camera: Camera = _DEMO_CAMERA,
) -> None:
    """Write a complete TUM RGB-D folder, camera.toml included, or nothing at all.

    Args:
        folder: must not exist yet, or be empty.
        seconds: length at 15 frames per second; the default is two laps and a little more.
        seed: of the room, the camera's shake and the noise; the same seed gives the same bytes.
        progress: called with (frames done, frames in all).
        camera: what to render with.

    Raises:
        SlamError: the folder is not empty or cannot be written.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise SlamError(f"there is something already; choose another folder or remove it: {folder}")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder.parent, prefix=".rendering-") as scratch:
            unfinished = Path(scratch) / folder.name
            times_s = np.arange(max(1, round(seconds * FRAMES_PER_S))) / FRAMES_PER_S
            _write_sequence(unfinished, times_s, seed, progress, camera)
            unfinished.replace(folder)
    except OSError as error:
        raise SlamError(
            f"cannot write the rendered sequence: {error.strerror}: {folder}"
        ) from error


def _write_sequence(
    folder: Path, times_s: FloatArray, seed: int, progress: Progress | None, camera: Camera
) -> None:
    for name in ("rgb", "depth"):
        (folder / name).mkdir(parents=True)
    truth = Trajectory(times_s + _START_S, drive(times_s, seed))
    write_frame = partial(_write_frame, folder, build_room(seed), camera, seed)
    pool = ThreadPoolExecutor(_WORKERS)
    try:
        jobs = pool.map(write_frame, range(len(truth)), truth.timestamps_s, truth.T_world_cam)
        for done, _ in enumerate(jobs, start=1):
            if progress:
                progress(done, len(truth))
    finally:
        pool.shutdown(cancel_futures=True)
    for name, kind in (("rgb", "jpg"), ("depth", "png")):
        lines = [f"{time_s:.6f} {name}/{time_s:.6f}.{kind}\n" for time_s in truth.timestamps_s]
        (folder / f"{name}.txt").write_text("# timestamp filename\n" + "".join(lines))
    write_tum(folder / "groundtruth.txt", truth)
    write_camera(folder / CAMERA_FILE, camera)


def _write_frame(
    folder: Path, room: Room, camera: Camera, seed: int, index: int, time_s: float, T: FloatArray
) -> None:
    # Noise belongs to the frame, not to the order in which threads happen to render.
    rng = np.random.default_rng([seed, 0xF0, index])
    perfect = render(room, camera, T, time_s)
    rgb = add_colour_noise(perfect.rgb, rng)
    depth_m = add_kinect_noise(perfect.depth_m, camera, rng)
    depth = np.rint(depth_m * camera.depth_scale).astype(np.uint16)
    jpeg = cv2.imencode(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1]
    png = cv2.imencode(".png", depth, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1]
    (folder / f"rgb/{time_s:.6f}.jpg").write_bytes(jpeg.tobytes())
    (folder / f"depth/{time_s:.6f}.png").write_bytes(png.tobytes())
