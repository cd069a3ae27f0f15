# SPDX-License-Identifier: Apache-2.0
"""What a long run costs: time per frame, memory per keyframe, loop queries, and the finish.

    python benchmarks/large_maps/long_run.py [--frames 5000 20000] [--out FOLDER]
    python benchmarks/large_maps/long_run.py --frames 1000 10000 50000 100000 --fresh-room 40

A camera is carried round a rendered room, 12 s a lap, again and again; with --fresh-room it then
walks through a door into another one, and so on. A lap is rendered once; each frame then gets grain
of its own. Frames come as fast as they are taken, so that nothing is done between them, and every
length is run in a process of its own. Prints a Markdown table with the exponents by which costs
grow, and writes it, the same as JSON and the curves into the folder. Linux only: it asks /proc for
the memory in use.
"""

import argparse
import gc
import json
import multiprocessing
import os
import resource
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from placerec.evaluation.drawing import canvas, line_styles, png, svg
from placerec.places.index import PlaceIndex
from placerec.recognizer import load
from slam import Camera, Config, Frame, Slam, TrackedFrame, Trajectory, compare_drift
from slam.commands.opening import DEFAULT_RECOGNIZER
from slam.demo import LAP_S
from slam.demo.kinect_noise import add_colour_noise, add_kinect_noise
from slam.demo.layout import furnished_room
from slam.demo.panels import Panel, light
from slam.demo.room import LAMPS_M, ROOM_SIZE_M, Room, assemble, build_room, render
from slam.geometry.features import search_images_on_one_thread
from slam.geometry.freed_memory import give_back, share_between_threads
from slam.types import FloatArray

FRAMES_PER_S = 15.0
LAP = round(FRAMES_PER_S * LAP_S)  # frames
WALK = round(FRAMES_PER_S * 10.0)  # and from one room to the next
DOOR_M, CLEAR_M = 1.2, 1.0  # its width, and how far from the wall nothing stands before it
EARLY = slice(500, 1500)  # around frame 1,000
LATE = slice(-1000, None)
BEGUN = 500  # frames before the last ones, where a run that takes these early begins
MB = 1024.0**2


def camera_of(width: int) -> Camera:
    """Return a camera of so many pixels across."""
    height, f = 3 * width // 4, 0.8203125 * width
    return Camera(width, height, f, f, 0.5 * (width - 1), 0.5 * (height - 1))


class Film:
    """Laps of rooms, each rendered once and played again and again, never twice the same.

    Attributes:
        camera: what takes it.
    """

    def __init__(self, width: int = 320, laps: int = 0, seed: int = 0) -> None:
        """Go so many laps round each room before the next one is entered; 0: stay in the first."""
        self.camera = camera_of(width)
        self._laps, self._seed = laps, seed
        self._T_room_cam = np.concatenate([lap(np.arange(LAP) / LAP), walk(np.arange(WALK) / WALK)])
        self._taken: tuple[int, list[tuple[Any, Any]]] = (0, self._photographed(0))
        # Drawing noise takes longer than tracking: every frame gets a cutting of one large sheet.
        rng = np.random.default_rng([seed, LAP])
        size = (2 * self.camera.height, 2 * self.camera.width)
        self._grain = np.rint(2.0 * rng.standard_normal((*size, 3))).astype(np.int16)
        self._wobble = (1.0 + 0.001 * rng.standard_normal(size)).astype(np.float32)

    def frame(self, i: int) -> Frame:
        """Return frame i; the same number gives the same frame. Rooms come one after the other."""
        (number,), (shot,) = self._room_and_shot(np.array([i]))
        if number != self._taken[0]:
            self._taken = (int(number), self._photographed(int(number)))
        rgb, depth_m = self._taken[1][shot]
        down, right = np.random.default_rng([self._seed, i]).integers(0, depth_m.shape)
        cutting = np.s_[down : down + self.camera.height, right : right + self.camera.width]
        grained = cv2.add(rgb, self._grain[cutting], dtype=cv2.CV_8U)
        return Frame(
            i / FRAMES_PER_S, np.asarray(grained, np.uint8), depth_m * self._wobble[cutting]
        )

    def truth(self, count: int) -> Trajectory:
        """Return where the camera is at each of so many frames."""
        numbers = np.arange(count)
        room, shot = self._room_and_shot(numbers)
        T_world_cam = self._T_room_cam[shot]
        T_world_cam[:, 0, 3] += ROOM_SIZE_M[0] * room
        return Trajectory(numbers / FRAMES_PER_S, T_world_cam)

    def _room_and_shot(self, numbers: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return (2, N): the rooms that frames are in, and which of a room's pictures they are."""
        if not self._laps:
            return np.array([np.zeros_like(numbers), numbers % LAP])
        room, since = np.divmod(numbers, self._laps * LAP + WALK)
        walked = since - self._laps * LAP
        return np.array([room, np.where(walked < 0, since % LAP, LAP + walked)])

    def _photographed(self, number: int) -> list[tuple[Any, Any]]:
        """Render a room's lap, and the walk into the next one."""
        seed = [self._seed, number] if number else [self._seed]
        room = rooms_in_a_row(self._seed, number) if self._laps else build_room(self._seed)
        shots = self._T_room_cam if self._laps else self._T_room_cam[:LAP]
        taken = []
        for i, T in enumerate(tqdm(shots, desc="rendering", unit=" frames", mininterval=1.0)):
            rng, perfect = np.random.default_rng([*seed, i]), render(room, self.camera, T)
            depth_m = add_kinect_noise(perfect.depth_m, self.camera, rng)
            taken.append((add_colour_noise(perfect.rgb, rng), depth_m))
        return taken


def rooms_in_a_row(seed: int, number: int) -> Room:
    """Return a room at the origin, and the rooms before and after it behind its doors."""
    panels: list[Panel] = []
    for beside in (-1, 0, 1):
        aside_m = np.array([beside * ROOM_SIZE_M[0], 0.0, 0.0])
        for each in room_with_doors(seed, number + beside):
            panels.append(replace(each, corner_m=each.corner_m + aside_m))
    return assemble(panels)


@lru_cache(maxsize=3)
def room_with_doors(seed: int, number: int) -> list[Panel]:
    """Return the lit panels of a room of the row, around the origin."""
    rng = np.random.default_rng([seed, 0x200, number + 1])
    return light(cut_doors(furnished_room(rng, *ROOM_SIZE_M)), LAMPS_M, rng)


def cut_doors(panels: list[Panel]) -> list[Panel]:
    """Return a room's panels with an opening in the two walls across x, and nothing before it."""
    kept = []
    for each in panels:
        corners = each.corner_m + np.array(
            [0.0 * each.right_m, each.right_m, each.down_m, each.right_m + each.down_m]
        )
        low, high = corners.min(axis=0), corners.max(axis=0)
        is_near = np.abs(corners[:, 0]).max() > ROOM_SIZE_M[0] / 2 - CLEAR_M
        is_upright = high[2] - low[2] > 0.01 or low[2] > 0.01
        is_in_the_way = low[1] < DOOR_M / 2 and high[1] > -DOOR_M / 2
        if not (is_near and is_upright and is_in_the_way and high[0] - low[0] < ROOM_SIZE_M[0] / 2):
            kept.append(each)
        elif high[1] - low[1] > ROOM_SIZE_M[1] - 0.1 and high[2] - low[2] > ROOM_SIZE_M[2] - 0.1:
            share = 0.5 * (1.0 - DOOR_M / ROOM_SIZE_M[1])
            columns = int(share * each.texture.shape[1])
            sides = ((0.0, each.texture[:, :columns]), (1.0 - share, each.texture[:, -columns:]))
            for start, texture in sides:
                corner_m, right_m = each.corner_m + start * each.right_m, share * each.right_m
                kept.append(Panel(corner_m, right_m, each.down_m, np.ascontiguousarray(texture)))
    return kept


def lap(phase: FloatArray) -> FloatArray:
    """Return (N, 4, 4) T_world_cam along an ellipse in the room; phases 0 and 1 are one place."""
    around = 2.0 * np.pi * phase
    yaw = around + 1.1 + 0.08 * np.sin(2.0 * around)
    pitch = -0.12 + 0.06 * np.sin(around)
    forward = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.stack([np.sin(yaw), -np.cos(yaw), 0.0 * yaw])
    centre_m = [0.8 * np.cos(around), 0.6 * np.sin(around), 1.3 + 0.05 * np.sin(2.0 * around)]
    return _poses(right, forward, centre_m)


def walk(phase: FloatArray) -> FloatArray:
    """Return (N, 4, 4) T_world_cam from where a lap ends to where one in the next room begins."""
    T_start = lap(np.zeros(1))[0]
    gone = phase**3 * (10.0 - 15.0 * phase + 6.0 * phase**2)
    yaw, pitch = 1.1 - 0.9 * np.sin(np.pi * phase) ** 2, np.full_like(phase, -0.12)
    forward = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.stack([np.sin(yaw), -np.cos(yaw), 0.0 * yaw])
    x, y, z = T_start[:3, 3]
    return _poses(right, forward, [x + ROOM_SIZE_M[0] * gone, y + 0.0 * gone, z + 0.0 * gone])


def _poses(right: FloatArray, forward: FloatArray, centre_m: Any) -> FloatArray:
    T_world_cam = np.tile(np.eye(4), (right.shape[1], 1, 1))
    for i, axis in enumerate((right, np.cross(forward, right, axis=0), forward, centre_m)):
        T_world_cam[:, :3, i] = np.transpose(axis)
    return T_world_cam


class TimedIndex(PlaceIndex):
    """A place index that notes how long each query takes."""

    seconds: list[float]

    def query(self, *asked: Any, **how: Any) -> Any:
        """Return the places most similar to an embedding."""
        start_s = time.perf_counter()
        answer = super().query(*asked, **how)
        self.seconds.append(time.perf_counter() - start_s)
        return answer


@dataclass(frozen=True)
class Run:
    """One run of N frames and K keyframes.

    Attributes:
        frame_s: (N,) from giving a frame to knowing where it was taken.
        cpu_s: (N,) what all threads worked meanwhile; other programs change it less.
        anew_s: (A,) what the last frames take in a run that begins shortly before them, right after
            this one: other rooms and a machine that is busier are no growth.
        memory_mb: (N,) in use after the frame, since before the first.
        keyframes: (N,) so far.
        query_s: (Q,) of comparing an image with the places so far, of which it has one or two.
        finish_s, peak_memory_mb: what finishing took, and the most memory that it needed.
        untracked, loops, false_loops: how many.
        ate_m: of the odometry and of the corrected trajectory.
    """

    frame_s: FloatArray
    cpu_s: FloatArray
    anew_s: FloatArray
    memory_mb: FloatArray
    keyframes: NDArray[np.int64]
    query_s: FloatArray
    finish_s: float
    peak_memory_mb: float
    untracked: int
    loops: int
    false_loops: int
    ate_m: tuple[float, float]

    @property
    def kb_per_keyframe(self) -> float:
        """How much more memory every further keyframe took in the second half of the frames."""
        half = slice(len(self.keyframes) // 2, None)
        return 1024.0 * float(np.polyfit(self.keyframes[half], self.memory_mb[half], 1)[0])

    def growth(self, per_frame: FloatArray, of: Callable[[FloatArray], float]) -> float:
        """Return how many times more the last frames take than those around frame 1,000."""
        return float(of(per_frame[LATE]) / of(per_frame[EARLY]))

    @property
    def growth_by_length(self) -> float:
        """How many times longer the last frames take than where a run has only just begun."""
        return float(np.median(self.frame_s[LATE]) / np.median(self.anew_s))


def measure(frames: int, recognizer: str, width: int = 320, laps: int = 0) -> Run:
    """Run so many frames and finish."""
    share_between_threads()  # as run_slam does, like what else comes before the first frame
    search_images_on_one_thread()
    film, TimedIndex.seconds = Film(width, laps), []
    with patch("slam.loops.loop_closure.PlaceIndex", TimedIndex):
        slam = Slam(film.camera, load(recognizer))
    frame_s, cpu_s, memory_mb = np.empty((3, frames))
    keyframes = np.zeros(frames, dtype=np.int64)
    gc.collect()
    gc.freeze()
    give_back()  # what loading and rendering freed would be counted as what tracking needs less
    before_mb = memory_in_use_mb()
    for i in tqdm(range(frames), desc="tracking", unit=" frames", mininterval=1.0):
        frame = film.frame(i)
        start_s, start_cpu_s = time.perf_counter(), time.process_time()
        tracked = slam.process(frame)
        frame_s[i] = time.perf_counter() - start_s
        cpu_s[i] = time.process_time() - start_cpu_s
        memory_mb[i] = memory_in_use_mb() - before_mb
        keyframes[i] = isinstance(tracked, TrackedFrame) and tracked.new_keyframe is not None
    start_s = time.perf_counter()
    result = slam.finish()
    finish_s = time.perf_counter() - start_s
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024.0 / MB
    drift = compare_drift(result, film.truth(frames), Config().evaluation)
    anew_s = taken_early(film, frames, recognizer)
    kept = [loop.is_false for loop in drift.loops if loop.is_false is not None]
    return Run(
        frame_s,
        cpu_s,
        anew_s,
        memory_mb,
        np.cumsum(keyframes),
        np.array(TimedIndex.seconds),
        finish_s,
        peak_mb - before_mb,
        untracked=len(result.untracked_s),
        loops=len(kept),
        false_loops=sum(kept),
        ate_m=(drift.odometry.ate_rmse_m, drift.corrected.ate_rmse_m),
    )


def taken_early(film: Film, frames: int, recognizer: str) -> FloatArray:
    """Return (A,) what the last of so many frames take in a run that has only just begun."""
    slam, seconds = Slam(film.camera, load(recognizer)), []
    for i in range(max(frames + LATE.start - BEGUN, 0), frames):
        frame = film.frame(i)
        start_s = time.perf_counter()
        slam.process(frame)
        seconds.append(time.perf_counter() - start_s)
    return np.array(seconds[LATE])


def memory_in_use_mb() -> float:
    """Return the memory that this process holds now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / MB


def table(runs: list[Run]) -> str:
    """Return the Markdown table, a column per run; times are medians but where it says so."""

    def ms(seconds: FloatArray) -> str:
        return f"{1e3 * np.median(seconds):.2f}"

    rows: list[tuple[str, Callable[[Run], str]]] = [
        ("keyframes", lambda run: str(run.keyframes[-1])),
        ("frames not tracked", lambda run: str(run.untracked)),
        ("ms per frame around frame 1,000", lambda run: ms(run.frame_s[EARLY])),
        ("ms per frame at the end", lambda run: ms(run.frame_s[LATE])),
        ("their ratio", lambda run: f"{run.growth(run.frame_s, np.median):.2f}"),
        ("ms for the same frames early in a run", lambda run: ms(run.anew_s)),
        ("their ratio to these", lambda run: f"{run.growth_by_length:.2f}"),
        ("the ratio of the means", lambda run: f"{run.growth(run.frame_s, np.mean):.2f}"),
        ("and of the work of all threads", lambda run: f"{run.growth(run.cpu_s, np.mean):.2f}"),
        ("longest frame, ms", lambda run: f"{1e3 * run.frame_s.max():.0f}"),
        ("kB per keyframe, second half", lambda run: f"{run.kb_per_keyframe:.0f}"),
        ("ms per loop query at the end", lambda run: ms(run.query_s[-100:])),
        ("MB in use before finishing", lambda run: f"{run.memory_mb[-1]:.0f}"),
        ("MB at most while finishing", lambda run: f"{run.peak_memory_mb:.0f}"),
        ("seconds for finishing", lambda run: f"{run.finish_s:.1f}"),
        ("loops kept", lambda run: f"{run.loops}, {run.false_loops} of them false"),
        ("ATE, m: odometry → corrected", lambda run: "{:.4f} → {:.4f}".format(*run.ate_m)),
    ]
    lines = ["| frames | " + " | ".join(str(len(run.frame_s)) for run in runs) + " |"]
    lines += ["|---" * (len(runs) + 1) + "|"]
    lines += [f"| {title} | " + " | ".join(map(cell, runs)) + " |" for title, cell in rows]
    return "\n".join(lines) + "\n"


COSTS: dict[str, Callable[[Run], float]] = {
    "ms per frame at the end": lambda run: 1e3 * float(np.median(run.frame_s[LATE])),
    "ms of all threads per frame at the end": lambda run: 1e3 * float(np.mean(run.cpu_s[LATE])),
    "MB in use before finishing": lambda run: float(run.memory_mb[-1]),
    "MB at most while finishing": lambda run: run.peak_memory_mb,
    "ms per loop query at the end": lambda run: 1e3 * float(np.median(run.query_s[-100:])),
    "seconds for finishing": lambda run: run.finish_s,
}


def exponents(runs: list[Run]) -> dict[str, float]:
    """Return the power of the number of frames by which each cost grows, by least squares."""
    log_frames = np.log([len(run.frame_s) for run in runs])
    return {
        name: float(np.polyfit(log_frames, np.log([cost(run) for run in runs]), 1)[0])
        for name, cost in COSTS.items()
    }


def as_json(runs: list[Run], **settings: Any) -> str:
    """Return what was measured for programs to read: one object per run, and the exponents."""
    measured = [
        {
            "frames": len(run.frame_s),
            "keyframes": int(run.keyframes[-1]),
            "untracked": run.untracked,
            "loops": run.loops,
            "false_loops": run.false_loops,
            "ate_odometry_m": run.ate_m[0],
            "ate_m": run.ate_m[1],
            "ratio to frame 1,000": run.growth(run.frame_s, np.median),
            "ratio to the same frames early in a run": run.growth_by_length,
            "kB per keyframe, second half": run.kb_per_keyframe,
            **{name: cost(run) for name, cost in COSTS.items()},
        }
        for run in runs
    ]
    grown = exponents(runs) if len(runs) > 1 else {}
    return json.dumps({**settings, "runs": measured, "exponents": grown}, indent=1) + "\n"


def draw(runs: list[Run], folder: Path) -> None:
    """Draw the three curves of every run, the shorter ones on top of the longer."""
    with canvas(8.0, 7.0) as figure:
        time_axes, memory_axes, query_axes = figure.subplots(3, 1)
        longest_first = sorted(runs, key=lambda run: -len(run.frame_s))
        for run, (colour, _) in zip(longest_first, line_styles(), strict=False):
            numbers, label = np.arange(len(run.frame_s)), f"{len(run.frame_s):,} frames"
            at, middle, slowest = _by_lap(run.frame_s)
            time_axes.plot(at, 1e3 * middle, color=colour, label=f"{label}, median of a lap")
            time_axes.plot(at, 1e3 * slowest, color=colour, lw=0.5, label="slowest of a lap")
            each_mb = run.memory_mb / np.maximum(run.keyframes, 1)
            memory_axes.plot(numbers, each_mb, color=colour, label=label)
            query_axes.plot(np.arange(len(run.query_s)), 1e3 * run.query_s, ".", color=colour, ms=2)
        time_axes.set(xlabel="frame", ylabel="ms per frame", ylim=(0, None))
        memory_axes.set(xlabel="frame", ylabel="MB in use per keyframe", ylim=(0, None))
        query_axes.set(xlabel="query", ylabel="ms per loop query", ylim=(0, None))
        time_axes.legend(ncols=2)
    (folder / "long_run.svg").write_bytes(svg(figure))
    (folder / "long_run.png").write_bytes(png(figure))


def _by_lap(values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the middle of each lap, the median in it and the maximum."""
    length = min(len(values), round(FRAMES_PER_S * LAP_S))
    laps = values[: len(values) // length * length].reshape(-1, length)
    at = (np.arange(len(laps), dtype=np.float64) + 0.5) * length
    return at, np.asarray(np.median(laps, axis=1), np.float64), laps.max(axis=1)


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, write and draw."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--frames", type=int, nargs="+", default=(5000, 20000), metavar="N")
    parser.add_argument("--recognizer", default=DEFAULT_RECOGNIZER, help="as for run_slam")
    parser.add_argument(
        "--fresh-room", type=int, default=0, metavar="LAPS", help="enter another room after so many"
    )
    parser.add_argument("--width", type=int, default=320, help="of the image, pixels")
    parser.add_argument("--out", type=Path, default=Path("runs/long"), metavar="FOLDER")
    parsed = parser.parse_args(arguments)
    if min(parsed.frames) <= EARLY.start:
        parser.error(f"--frames {min(parsed.frames)}: more than {EARLY.start} are needed")
    parsed.out.mkdir(parents=True, exist_ok=True)
    runs = []
    for frames in parsed.frames:
        # A process of its own: what an earlier run gave back to Python would look like no memory.
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
            asked = (frames, parsed.recognizer, parsed.width, parsed.fresh_room)
            runs.append(process.submit(measure, *asked).result())
    laps = parsed.fresh_room
    rooms = f"a fresh room every {laps} laps" if laps else "one room"
    caption = f"Recognizer {parsed.recognizer}; {parsed.width} pixels across; {rooms}."
    text = f"{table(runs)}\n{caption}\n"
    if len(runs) > 1:
        grown = "; ".join(f"{name}: {power:.2f}" for name, power in exponents(runs).items())
        text += f"Grows with the number of frames to the power of: {grown}.\n"
    print(text, end="")
    (parsed.out / "long_run.md").write_text(text)
    settings = {"recognizer": parsed.recognizer, "width": parsed.width, "fresh_room_laps": laps}
    (parsed.out / "long_run.json").write_text(as_json(runs, **settings))
    draw(runs, parsed.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
