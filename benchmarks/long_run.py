# SPDX-License-Identifier: Apache-2.0
"""What a long run costs: time per frame, memory per keyframe, loop queries, and the finish.

    python benchmarks/long_run.py [--frames 5000 20000] [--recognizer NAME] [--out FOLDER]

A camera is carried round a rendered room, 12 s a lap, again and again. The lap is rendered once;
each frame then gets grain of its own. Frames come as fast as they are taken, so that nothing is
done between them, and every length is run in a process of its own. Prints a Markdown table, and
writes it and the curves into the folder. Linux only: it asks /proc for the memory in use.
"""

import argparse
import gc
import multiprocessing
import os
import resource
import sys
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from placerec.drawing import canvas, line_styles, png, svg
from placerec.index import PlaceIndex
from placerec.recognizer import load
from slam import Camera, Config, Frame, Slam, TrackedFrame, Trajectory, compare_drift
from slam.__main__ import DEFAULT_RECOGNIZER
from slam.demo import LAP_S
from slam.demo.kinect_noise import add_colour_noise, add_kinect_noise
from slam.demo.room import build_room, render
from slam.types import FloatArray

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
FRAMES_PER_S = 15.0
EARLY = slice(500, 1500)  # around frame 1,000
LATE = slice(-1000, None)
MB = 1024.0**2


class Film:
    """A closed lap of a room, rendered once and played without end, never twice the same."""

    def __init__(self, seed: int = 0) -> None:
        self._seed = seed
        room, count = build_room(seed), round(FRAMES_PER_S * LAP_S)
        self.T_world_cam = lap(np.arange(count) / count)
        self._lap = []
        for i, T in enumerate(tqdm(self.T_world_cam, desc="rendering", unit=" frames")):
            rng, perfect = np.random.default_rng([seed, i]), render(room, CAMERA, T)
            depth_m = add_kinect_noise(perfect.depth_m, CAMERA, rng)
            self._lap.append((add_colour_noise(perfect.rgb, rng), depth_m))
        # Drawing noise takes longer than tracking: every frame gets a cutting of one large sheet.
        rng, size = np.random.default_rng([seed, count]), (2 * CAMERA.height, 2 * CAMERA.width)
        self._grain = np.rint(2.0 * rng.standard_normal((*size, 3))).astype(np.int16)
        self._wobble = (1.0 + 0.001 * rng.standard_normal(size)).astype(np.float32)

    def frame(self, i: int) -> Frame:
        """Return frame i; the same number gives the same frame."""
        rgb, depth_m = self._lap[i % len(self._lap)]
        down, right = np.random.default_rng([self._seed, i]).integers(0, depth_m.shape)
        cutting = np.s_[down : down + CAMERA.height, right : right + CAMERA.width]
        grained = cv2.add(rgb, self._grain[cutting], dtype=cv2.CV_8U)
        return Frame(
            i / FRAMES_PER_S, np.asarray(grained, np.uint8), depth_m * self._wobble[cutting]
        )

    def truth(self, count: int) -> Trajectory:
        """Return where the camera is at each of so many frames."""
        numbers = np.arange(count)
        return Trajectory(numbers / FRAMES_PER_S, self.T_world_cam[numbers % len(self._lap)])


def lap(phase: FloatArray) -> FloatArray:
    """Return (N, 4, 4) T_world_cam along an ellipse in the room; phases 0 and 1 are one place."""
    around = 2.0 * np.pi * phase
    yaw = around + 1.1 + 0.08 * np.sin(2.0 * around)
    pitch = -0.12 + 0.06 * np.sin(around)
    forward = np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)])
    right = np.stack([np.sin(yaw), -np.cos(yaw), 0.0 * yaw])
    centre_m = [0.8 * np.cos(around), 0.6 * np.sin(around), 1.3 + 0.05 * np.sin(2.0 * around)]
    T_world_cam = np.tile(np.eye(4), (len(phase), 1, 1))
    for i, axis in enumerate((right, np.cross(forward, right, axis=0), forward, centre_m)):
        T_world_cam[:, :3, i] = np.transpose(axis)
    return T_world_cam


class TimedIndex(PlaceIndex):
    """A place index that notes how long the queries for each place take, until that is added."""

    seconds: list[float]
    _spent_s = 0.0

    def query(self, *asked: Any, **how: Any) -> Any:
        """Return the places most similar to an embedding."""
        start_s = time.perf_counter()
        answer = super().query(*asked, **how)
        self._spent_s += time.perf_counter() - start_s
        return answer

    def add(self, embedding: Any) -> int:
        """Remember an embedding."""
        self.seconds.append(self._spent_s)
        self._spent_s = 0.0
        return super().add(embedding)


@dataclass(frozen=True)
class Run:
    """One run of N frames and K keyframes.

    Attributes:
        frame_s: (N,) from giving a frame to knowing where it was taken.
        cpu_s: (N,) what all threads worked meanwhile; other programs do not change it.
        memory_mb: (N,) in use after the frame, since before the first.
        keyframes: (N,) so far.
        query_s: (K,) of comparing a keyframe with all earlier ones.
        finish_s, peak_memory_mb: what finishing took, and the most memory that it needed.
        untracked, loops, false_loops: how many.
        ate_m: of the odometry and of the corrected trajectory.
    """

    frame_s: FloatArray
    cpu_s: FloatArray
    memory_mb: FloatArray
    keyframes: NDArray[np.int64]
    query_s: FloatArray
    finish_s: float
    peak_memory_mb: float
    untracked: int
    loops: int
    false_loops: int
    ate_m: tuple[float, float]

    def growth(self, per_frame: FloatArray, of: Callable[[FloatArray], float]) -> float:
        """Return how many times more the last frames take than those around frame 1,000."""
        return float(of(per_frame[LATE]) / of(per_frame[EARLY]))


def measure(frames: int, recognizer: str) -> Run:
    """Run so many frames and finish."""
    film, TimedIndex.seconds = Film(), []
    with patch("slam.loops.loop_closure.PlaceIndex", TimedIndex):
        slam = Slam(CAMERA, load(recognizer))
    frame_s, cpu_s, memory_mb = np.empty((3, frames))
    keyframes = np.zeros(frames, dtype=np.int64)
    gc.collect()
    gc.freeze()  # as run_slam does
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
    kept = [loop.is_false for loop in drift.loops if loop.is_false is not None]
    return Run(
        frame_s,
        cpu_s,
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
        ("the ratio of the means", lambda run: f"{run.growth(run.frame_s, np.mean):.2f}"),
        ("and of the work of all threads", lambda run: f"{run.growth(run.cpu_s, np.mean):.2f}"),
        ("longest frame, ms", lambda run: f"{1e3 * run.frame_s.max():.0f}"),
        ("MB per keyframe", lambda run: f"{run.memory_mb[-1] / run.keyframes[-1]:.2f}"),
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
        query_axes.set(xlabel="keyframe", ylabel="ms per loop query", ylim=(0, None))
        time_axes.legend(ncols=2)
    (folder / "long_run.svg").write_bytes(svg(figure))
    (folder / "long_run.png").write_bytes(png(figure))


def _by_lap(values: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return the middle of each lap, the median in it and the maximum."""
    length = min(len(values), round(FRAMES_PER_S * LAP_S))
    laps = values[: len(values) // length * length].reshape(-1, length)
    return (np.arange(len(laps)) + 0.5) * length, np.median(laps, axis=1), laps.max(axis=1)


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, write and draw."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--frames", type=int, nargs="+", default=(5000, 20000), metavar="N")
    parser.add_argument("--recognizer", default=DEFAULT_RECOGNIZER, help="as for run_slam")
    parser.add_argument("--out", type=Path, default=Path("runs/long"), metavar="FOLDER")
    parsed = parser.parse_args(arguments)
    if min(parsed.frames) <= EARLY.start:
        parser.error(f"--frames {min(parsed.frames)}: more than {EARLY.start} are needed")
    parsed.out.mkdir(parents=True, exist_ok=True)
    runs = []
    for frames in parsed.frames:
        # A process of its own: what an earlier run gave back to Python would look like no memory.
        with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as process:
            runs.append(process.submit(measure, frames, parsed.recognizer).result())
    caption = f"Recognizer {parsed.recognizer}; {CAMERA.width}x{CAMERA.height} pixels."
    text = f"{table(runs)}\n{caption}\n"
    print(text, end="")
    (parsed.out / "long_run.md").write_text(text)
    draw(runs, parsed.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
