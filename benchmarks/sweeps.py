# SPDX-License-Identifier: Apache-2.0
"""What is left of the demo's figures in other worlds, by other cameras and clocks: one table.

    python benchmarks/sweeps.py [--only NAMES...] [--seconds 24.5] [--recognizer NAME]
        [--data FOLDER] [--out FILE]

A row is the demo with one thing changed. "World" rows have the demo's own pixels, with all depths
and true positions multiplied. "Room" rows are rendered anew: to a depth sensor that is blind beyond
5 m, 7 of 10 features have no depth in a room of 15 x 12 m, and in one of 20 x 16 m nearly none has,
so that little is left to tell its size. "Clock" rows have the demo's own pixels, too: the camera is
carried so many times faster, and its shutter is global. Nothing is said to the product but what a
user's camera.toml says, and no setting differs from its default.

Errors are those of the run as reported. Rows of another world have theirs divided by its size, too,
and there a loop is false from an error as many times larger.
"""

import argparse
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

from tqdm import tqdm

from placerec.recognizer import PlaceRecognizer, load
from slam import Config, Slam, SlamResult, compare_drift, open_sequence, read_tum
from slam.commands.opening import DEFAULT_RECOGNIZER
from slam.datasets import Sequence, read_camera, write_camera
from slam.datasets.cameras import CAMERA_FILE
from slam.demo.recording import FRAMES_PER_S, LAP_S, render_sequence
from slam.evaluation.trajectory import write_tum
from slam.types import Camera, Trajectory

VGA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
QUARTER = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
FOURFOLD = Camera(1280, 960, 1050.0, 1050.0, 639.5, 479.5)
DEMO_SECONDS = 2.0 * LAP_S + 0.5


@dataclass(frozen=True)
class Rendering:
    """What images are rendered of: everything but the length is the demo's unless said."""

    name: str = "demo"
    camera: Camera = VGA
    frames_per_s: float = FRAMES_PER_S
    enlarged: float = 1.0


@dataclass(frozen=True)
class Sweep:
    """A rendering, and what is made of its pixels.

    Attributes:
        rendering: where the images come from.
        world: all depths and true positions are multiplied by it.
        clock: all time stamps are divided by it.
    """

    rendering: Rendering = Rendering()
    world: float = 1.0
    clock: float = 1.0

    @property
    def size(self) -> float:
        """How many times larger than the demo's the true path is."""
        return self.world * self.rendering.enlarged


SWEEPS = {
    "demo": Sweep(),
    "world-x4": Sweep(world=4.0),
    "world-x0.5": Sweep(world=0.5),
    "room-x3": Sweep(Rendering("room-x3", enlarged=3.0)),
    "room-x4": Sweep(Rendering("room-x4", enlarged=4.0)),
    "320x240": Sweep(Rendering("320x240", QUARTER)),
    "1280x960": Sweep(Rendering("1280x960", FOURFOLD)),
    "10-per-s": Sweep(Rendering("10-per-s", frames_per_s=10.0)),
    "60-per-s": Sweep(Rendering("60-per-s", frames_per_s=60.0)),
    "clock-x2": Sweep(clock=2.0),
    "clock-x4": Sweep(clock=4.0),
}


def rendered(rendering: Rendering, seconds: float, data: Path) -> Path:
    """Return the folder of a rendering below another, where it may be from an earlier run."""
    folder = data / f"{rendering.name}-{seconds:g}s"
    if folder.is_dir():
        return folder
    with tqdm(desc=f"rendering {folder.name}", unit=" frames", disable=None) as bar:
        render_sequence(
            folder,
            seconds,
            progress=lambda done, _: bar.update(done - bar.n),
            camera=rendering.camera,
            frames_per_s=rendering.frames_per_s,
            enlarged=rendering.enlarged,
        )
    return folder


def derived(source: Path, sweep: Sweep, folder: Path) -> Path:
    """Write a TUM folder of a rendering's images, in another world or by another clock."""
    folder.mkdir()
    for kind in ("rgb", "depth"):
        (folder / kind).symlink_to((source / kind).resolve())
        lines = (source / f"{kind}.txt").read_text().splitlines()
        entries = [line.split() for line in lines if not line.startswith("#")]
        text = "".join(f"{float(t) / sweep.clock:.6f} {file}\n" for t, file in entries)
        (folder / f"{kind}.txt").write_text(text)
    camera, truth = read_camera(source / CAMERA_FILE), read_tum(source / "groundtruth.txt")
    depth_scale = camera.depth_scale / sweep.world
    write_camera(folder / CAMERA_FILE, replace(camera, depth_scale=depth_scale))
    stamps_s = truth.timestamps_s / sweep.clock
    moved = Trajectory(stamps_s, truth.enlarged(sweep.world).T_world_cam)
    write_tum(folder / "groundtruth.txt", moved)
    return folder


def run(sequence: Sequence, recognizer: PlaceRecognizer, config: Config) -> SlamResult:
    """Return what the pipeline makes of a sequence."""
    slam = Slam(sequence.camera, recognizer, config)
    for frame in sequence:
        slam.process(frame)
    return slam.finish()


HEADER = (
    "| | frames tracked | segments | keyframes | loops accepted | of them false | ATE live, m:"
    " odometry → corrected | ATE in the end, m: without loops → with | the last / size, m |\n"
    "|---|---|---|---|---|---|---|---|---|"
)


def row(name: str, sequence: Sequence, recognizer: PlaceRecognizer, size: float) -> str:
    """Run a sequence whose true path is `size` times the demo's and return its row."""
    limits = Config().evaluation
    false_m = limits.false_loop_translation_m * size
    limits = limits.model_copy(update={"false_loop_translation_m": false_m})
    result = run(sequence, recognizer, Config(evaluation=limits))
    assert sequence.ground_truth is not None
    drift = compare_drift(result, sequence.ground_truth, limits)
    verdicts = [loop.is_false for loop in drift.loops if loop.is_false is not None]
    tracked = len(result.trajectory)
    live_m = drift.live.ate_rmse_m if drift.live else float("nan")
    corrected_m = drift.corrected.ate_rmse_m
    cells = [
        name,
        f"{tracked} of {tracked + len(result.untracked_s)}",
        len({keyframe.segment for keyframe in result.keyframes}),
        len(result.keyframes),
        sum(attempt.rejection is None for attempt in result.attempts),
        sum(verdicts),
        f"{drift.odometry.ate_rmse_m:.4f} → {live_m:.4f}",
        f"{drift.without_loops.ate_rmse_m:.4f} → {corrected_m:.4f}",
        f"{corrected_m / size:.4f}",
    ]
    return "| " + " | ".join(str(cell) for cell in cells) + " |"


def main(arguments: list[str] | None = None) -> int:
    """Render what is missing, run every row, print and write."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--only", nargs="+", choices=SWEEPS, default=list(SWEEPS), help="rows")
    parser.add_argument(
        "--seconds", type=float, default=DEMO_SECONDS, help="of the camera's path; a lap is 12"
    )
    parser.add_argument("--recognizer", default=DEFAULT_RECOGNIZER, help="as for run_slam")
    parser.add_argument("--data", type=Path, help="a folder that renderings are kept in")
    parser.add_argument("--out", type=Path, help="a file that the table is written to as well")
    parsed = parser.parse_args(arguments)
    recognizer, lines = load(parsed.recognizer), [HEADER]
    print(HEADER, flush=True)
    with tempfile.TemporaryDirectory(prefix="loopclose-") as scratch:
        for name in parsed.only:
            sweep = SWEEPS[name]
            source = rendered(sweep.rendering, parsed.seconds, parsed.data or Path(scratch))
            folder = derived(source, sweep, Path(scratch) / name)
            sequence = open_sequence(folder, Config().input)
            lines.append(row(name, sequence, recognizer, sweep.size))
            print(lines[-1], flush=True)
    caption = f"{parsed.seconds:g} s of the demo's path, recognizer {parsed.recognizer}."
    print(f"\n{caption}")
    if parsed.out:
        parsed.out.write_text("\n".join([*lines, "", caption, ""]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
