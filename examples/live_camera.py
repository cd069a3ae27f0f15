# SPDX-License-Identifier: Apache-2.0
"""Run live: track frames as a camera delivers them, and print what happens.

    python examples/live_camera.py                       a rendered room, filmed while you watch
    python examples/live_camera.py RECORDING             a recording, as fast as it was filmed
    python examples/live_camera.py --realsense           an Intel RealSense (pyrealsense2 from pip)
    python examples/live_camera.py --realsense --record FOLDER     keep it; run_slam reads FOLDER

`Slam.process` takes one `Frame` after the other, so that anything that yields frames can stand in
for the camera. A Kinect or Xtion through OpenCV, where that was built with OpenNI 2, would be

    device = cv2.VideoCapture(cv2.CAP_OPENNI2)
    device.set(cv2.CAP_PROP_OPENNI_REGISTRATION, 1)  # depth as the colour camera sees it
    while device.grab():
        depth_m = device.retrieve(flag=cv2.CAP_OPENNI_DEPTH_MAP)[1].astype(np.float32) / 1000
        bgr = device.retrieve(flag=cv2.CAP_OPENNI_BGR_IMAGE)[1]
        yield Frame(time.monotonic(), bgr[..., ::-1].copy(), depth_m)
"""

import argparse
import gc
import json
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec import load
from slam import (
    Camera,
    Config,
    Frame,
    LoopcloseError,
    Rejection,
    Slam,
    SlamError,
    SlamResult,
    open_sequence,
    write_run,
)
from slam.datasets import resolve
from slam.demo import LAP_S, build_room, drive, render

ROOM_CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5, depth_scale=1000.0)
ROOM_FRAMES_PER_S = 15.0


class Clock(Protocol):
    """The part of the module `time` that is used here; the tests bring one that takes no time."""

    def monotonic(self) -> float:
        """Return the time, seconds."""

    def sleep(self, seconds: float, /) -> None:
        """Let so much time pass."""


def film(
    times_s: NDArray[np.float64], frame: Callable[[int], Frame], clock: Clock = time
) -> Iterator[Frame]:
    """Yield frames as a live camera would, which does not wait for the program.

    A frame comes at its own time. A program that is late gets the newest one; those before it are
    dropped.
    """
    start_s = clock.monotonic() - times_s[0]
    i = 0
    while i < len(times_s):
        clock.sleep(max(0.0, start_s + times_s[i] - clock.monotonic()))
        newest = int(np.searchsorted(times_s, clock.monotonic() - start_s, side="right")) - 1
        i = max(i, newest)
        yield frame(i)
        i += 1


def filmed_room(seconds: float, clock: Clock = time) -> tuple[Camera, Iterator[Frame]]:
    """Return a camera that is carried round a rendered room, and its frames."""
    room = build_room(seed=0)
    times_s = np.arange(max(1, round(seconds * ROOM_FRAMES_PER_S))) / ROOM_FRAMES_PER_S
    poses = drive(times_s, seed=0)
    frames = film(times_s, lambda i: render(room, ROOM_CAMERA, poses[i], times_s[i]), clock)
    return ROOM_CAMERA, frames


def replayed(name: str, clock: Clock = time) -> tuple[Camera, Iterator[Frame]]:
    """Return the camera of a recording, and its frames at the speed they were filmed."""
    sequence = open_sequence(resolve(name), Config().input)
    return sequence.camera, film(sequence.timestamps_s, sequence.frame, clock)


def realsense() -> tuple[Camera, Iterator[Frame]]:
    """Return the camera that is plugged in, and its frames until Ctrl-C."""
    try:
        import pyrealsense2 as rs
    except ImportError as error:
        raise SlamError("pyrealsense2 is missing: python -m pip install pyrealsense2") from error
    pipeline, config, align = rs.pipeline(), rs.config(), rs.align(rs.stream.color)
    config.enable_stream(rs.stream.color, 640, 480, rs.format.rgb8, 30)
    config.enable_stream(rs.stream.depth, 640, 480, rs.format.z16, 30)
    try:
        profile = pipeline.start(config)
    except RuntimeError as error:
        raise SlamError(f"the camera does not start: {error}") from error
    metres_per_unit = profile.get_device().first_depth_sensor().get_depth_scale()
    lens = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
    pinhole = lens.width, lens.height, lens.fx, lens.fy, lens.ppx, lens.ppy

    def frames() -> Iterator[Frame]:
        try:
            while True:
                images = align.process(pipeline.wait_for_frames())
                color, depth = images.get_color_frame(), images.get_depth_frame()
                rgb = np.array(color.get_data())  # copies: the device takes its memory back
                depth_m = np.array(depth.get_data(), np.float32) * np.float32(metres_per_unit)
                yield Frame(color.get_timestamp() / 1000.0, rgb, depth_m)
        finally:
            pipeline.stop()

    return Camera(*pinhole, tuple(lens.coeffs), 1.0 / metres_per_unit), frames()


def recorded(frames: Iterable[Frame], camera: Camera, folder: Path) -> Iterator[Frame]:
    """Pass the frames on, and write each into a folder that `open_sequence` reads."""
    if folder.exists():
        raise SlamError(f"the folder exists already; choose another one: {folder}")
    for name in ("color", "depth"):
        (folder / name).mkdir(parents=True)
    lens = {"ppx": camera.cx, "ppy": camera.cy, "fx": camera.fx, "fy": camera.fy}
    size = {"width": camera.width, "height": camera.height}
    rest = {"model": "brown_conrady", "coeffs": camera.distortion}
    intrinsics = {**size, **lens, **rest, "depth_scale": 1.0 / camera.depth_scale}
    (folder / "intrinsics.json").write_text(json.dumps(intrinsics, indent=2))
    with (folder / "timestamps.csv").open("w") as timestamps:
        timestamps.write("frame,timestamp_s\n")
        for i, frame in enumerate(frames):
            depth = np.clip(np.rint(frame.depth_m * camera.depth_scale), 0, 65535)
            cv2.imwrite(str(folder / f"color/{i:06d}.png"), frame.rgb[..., ::-1])
            cv2.imwrite(str(folder / f"depth/{i:06d}.png"), depth.astype(np.uint16))
            timestamps.write(f"{i},{frame.timestamp_s:.6f}\n")
            yield frame


def run(camera: Camera, frames: Iterable[Frame]) -> SlamResult:
    """Track frame by frame until there are no more, or Ctrl-C, and print what becomes of each."""
    recognizer = load("learned")
    gc.collect()
    gc.freeze()  # garbage collection then skips what is loaded by now, and frames are not held up
    slam = Slam(camera, recognizer)
    is_lost = False
    interrupted = threading.Event()  # by Ctrl-C, which waits for the frame to be finished
    usual = signal.signal(signal.SIGINT, lambda *_: interrupted.set())
    try:
        for frame in frames:
            placed, when = slam.process(frame), f"{frame.timestamp_s:10.3f} s"
            if isinstance(placed, Rejection):
                if not is_lost:
                    print(f"{when}  lost: {placed.reason}")
            elif placed.new_keyframe:
                x, y, z = placed.new_keyframe.T_odom_cam[:3, 3]
                print(f"{when}  keyframe {placed.new_keyframe.id} at {x:.2f} {y:.2f} {z:.2f} m")
            elif is_lost:
                print(f"{when}  found again, by keyframe {placed.keyframe_id}")
            is_lost = isinstance(placed, Rejection)
            if interrupted.is_set():
                break
    finally:
        signal.signal(signal.SIGINT, usual)
    result = slam.finish()
    loops = [each for each in result.attempts if each.rejection is None]
    closed = ", ".join(f"{loop.query_id} with {loop.match_id}" for loop in loops)
    print(f"{len(result.trajectory)} frames tracked, {len(result.keyframes)} keyframes")
    print(f"{len(loops)} loops closed{': ' if loops else ''}{closed}")
    print(*result.warnings, sep="\n", end="\n" if result.warnings else "")
    return result


def main(arguments: list[str] | None = None, clock: Clock = time) -> None:
    """Film, track, and leave the run in a folder, report.html included."""
    parser = argparse.ArgumentParser(description="Run live, as frames come.")
    parser.add_argument("recording", nargs="?", help="recording to play, named as for run_slam")
    parser.add_argument("--realsense", action="store_true", help="the camera that is plugged in")
    parser.add_argument("--record", type=Path, metavar="FOLDER", help="keep the frames there")
    parser.add_argument("--seconds", type=float, default=2.2 * LAP_S, help="of the rendered room")
    parser.add_argument("--out", type=Path, default=Path("runs/live"), metavar="FOLDER")
    told = parser.parse_args(arguments)
    told.out.mkdir(parents=True, exist_ok=True)
    if told.realsense:
        camera, frames = realsense()
    elif told.recording:
        camera, frames = replayed(told.recording, clock)
    else:
        camera, frames = filmed_room(told.seconds, clock)
    if told.record:
        frames = recorded(frames, camera, told.record)
    result = run(camera, frames)
    write_run(told.out, result, None, None, Config(), "live", "python examples/live_camera.py")
    print(f"report     {told.out / 'report.html'}")


if __name__ == "__main__":
    try:
        main()
    except LoopcloseError as error:
        sys.exit(str(error))
