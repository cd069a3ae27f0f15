# SPDX-License-Identifier: Apache-2.0
"""What becomes of an odometry from elsewhere: a row per odometry, as a Markdown table.

    python benchmarks/external_odometry.py [SEQUENCES...] [--only ROWS...] [--out FILE]

The sequences are the demo (rendered where --demo FOLDER has it not) and those of the TUM benchmark
that are on this machine. The made-up rows are the sequence's own ground truth with one thing wrong
with it; a row that ends in "auto" is given to `--odometry.T-base-cam auto`, `.scale auto` or
`.time-offset-s auto`. The others are files in the folder `odometry` beside the sequences: what
other systems made of them, named SYSTEM_SEQUENCE*.txt.

Errors are those of the camera's path: as it came, where it was read rightly; live, corrected, where
it has poses; in the end without loops, and with; and of all poses that came, corrected.
"""

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from placerec.recognizer import load
from slam import Config, Slam, SlamResult, compare_drift, open_sequence
from slam.commands.opening import DEFAULT_RECOGNIZER, DEMO
from slam.datasets import Sequence, resolve
from slam.datasets.pose_files import read_pose_file
from slam.demo.recording import render_sequence
from slam.evaluation.drift import trajectory_error
from slam.external_odometry.conventions import Convention
from slam.external_odometry.given_poses import poses_between
from slam.geometry import se3
from slam.types import FloatArray, SlamError, Trajectory

SEQUENCES = (DEMO, "fr1_desk", "fr1_xyz")
# A camera that looks ahead, and a little down, from a mast on a robot: x ahead, z up.
T_BASE_CAM = se3.from_rotation_translation(
    Rotation.from_euler("xyz", [-100.0, 5.0, -85.0], degrees=True).as_matrix(),
    np.array([0.12, -0.05, 0.30]),
)
LATE_S = 0.15


@dataclass(frozen=True)
class Row:
    """An odometry, and the settings that it is run with."""

    odometry: Callable[[Sequence], Trajectory]
    settings: dict[str, object] = field(default_factory=dict)


def truth(sequence: Sequence) -> Trajectory:
    """Return the true poses at the images' times."""
    assert sequence.ground_truth is not None
    poses = poses_between(sequence.ground_truth, sequence.timestamps_s)
    known = np.isfinite(poses[:, 0, 0])
    return Trajectory(sequence.timestamps_s[known], poses[known])


def stepped(true: Trajectory, error: Callable[[int, float], FloatArray]) -> Trajectory:
    """Return the true poses with an error, a (6,) tangent, after each of their steps."""
    T = [true.T_world_cam[0]]
    steps = se3.inverse(true.T_world_cam[:-1]) @ true.T_world_cam[1:]
    for i, (step, seconds) in enumerate(zip(steps, np.diff(true.timestamps_s), strict=True)):
        T.append(T[-1] @ step @ se3.exp(error(i, float(seconds))))
    return Trajectory(true.timestamps_s, np.array(T))


def read_as(**wrong: Any) -> Callable[[Sequence], Trajectory]:
    """Return what writes the truth down in another convention."""
    convention = Convention(**wrong)
    return lambda sequence: convention.as_given(truth(sequence))


def jumping(sequence: Sequence) -> Trajectory:
    """Return the truth with a single leap of 32 cm in the middle."""
    true = truth(sequence)
    T = true.T_world_cam.copy()
    T[len(T) // 2 :, :3, 3] += [0.2, 0.2, 0.15]
    return Trajectory(true.timestamps_s, T)


def slipping(sequence: Sequence) -> Trajectory:
    """Return the truth with 2.2 mm too much in each of 100 steps."""
    true = truth(sequence)
    first = len(true) // 2
    slip = np.array([0.0, 0.0, 0.0, 0.002, 0.001, 0.0])
    return stepped(true, lambda i, _: slip * float(first <= i < first + 100))


def noisy(sequence: Sequence) -> Trajectory:
    """Return the truth with 3 degrees and 10 cm of noise, per axis, in every step."""
    rng, sigma = np.random.default_rng(0), np.repeat([np.radians(3.0), 0.1], 3)
    return stepped(truth(sequence), lambda *_: rng.normal(size=6) * sigma)


def drifting(sequence: Sequence) -> Trajectory:
    """Return the drift of examples/poses_from_elsewhere.py: a constant part and a random one."""
    rng, unit = np.random.default_rng(0), np.repeat([np.radians(0.25), 0.009], 3)
    bias = rng.normal(size=6)

    def error(_: int, seconds: float) -> FloatArray:
        noise = 0.3 * np.sqrt(seconds) * rng.normal(size=6)
        return np.asarray(unit * (seconds * bias + noise))

    return stepped(truth(sequence), error)


def own(sequence: Sequence) -> Trajectory:
    """Return what our own odometry makes of the sequence."""
    return run(sequence, None, {}).odometry


def own_read_as(**wrong: Any) -> Callable[[Sequence], Trajectory]:
    """Return what writes that down in another convention."""
    convention = Convention(**wrong)
    return lambda sequence: convention.as_given(own(sequence))


MADE_UP = {
    "truth": Row(truth),
    "own odometry": Row(own),
    "own odometry of base_link, auto": Row(
        own_read_as(T_base_cam=T_BASE_CAM), {"T_base_cam": "auto"}
    ),
    "own odometry 150 ms late, auto": Row(
        own_read_as(time_offset_s=LATE_S), {"time_offset_s": "auto"}
    ),
    "every second pose": Row(
        lambda s: Trajectory(*(each[::2] for each in vars(truth(s)).values()))
    ),
    "drift": Row(drifting),
    "jump of 32 cm": Row(jumping),
    "slip over 100 steps": Row(slipping),
    "3 deg and 10 cm per step": Row(noisy),
    "5 % too long": Row(read_as(scale=1 / 1.05)),
    "5 % too long, auto": Row(read_as(scale=1 / 1.05), {"scale": "auto"}),
    "20 % too long, auto": Row(read_as(scale=1 / 1.2), {"scale": "auto"}),
    "base_link": Row(read_as(T_base_cam=T_BASE_CAM)),
    "base_link, auto": Row(read_as(T_base_cam=T_BASE_CAM), {"T_base_cam": "auto"}),
    "inverted, auto": Row(read_as(is_inverted=True), {"T_base_cam": "auto"}),
    "w first, auto": Row(read_as(is_w_first=True), {"T_base_cam": "auto"}),
    "150 ms late, auto": Row(read_as(time_offset_s=LATE_S), {"time_offset_s": "auto"}),
}


def run(sequence: Sequence, odometry: Trajectory | None, settings: dict[str, object]) -> SlamResult:
    """Run on a sequence, with the poses of an odometry handed over as they would come."""
    slam = Slam(
        sequence.camera, load(DEFAULT_RECOGNIZER), Config.model_validate({"odometry": settings})
    )
    poses = iter(() if odometry is None else zip(*vars(odometry).values(), strict=True))
    last_s = -np.inf
    for frame in tqdm(sequence, leave=False):
        while last_s <= frame.timestamp_s and (pose := next(poses, None)):
            slam.add_pose(*pose)
            last_s = pose[0]
        slam.process(frame)
    for pose in poses:
        slam.add_pose(*pose)
    return slam.finish()


def rows(sequence: Sequence, folder: Path) -> Iterator[tuple[str, Row]]:
    """Yield the made-up odometries, and those that other systems left for the sequence."""
    yield from MADE_UP.items()
    name = sequence.name.replace("rgbd_dataset_freiburg", "fr")
    for file in sorted((folder.parent / "odometry").glob(f"*_{name}*.txt")):
        poses = read_pose_file(file, sequence.timestamps_s).trajectory
        yield file.stem, Row(partial(_always, poses))


def _always(poses: Trajectory, _: Sequence) -> Trajectory:
    return poses


def _also_in(given: Trajectory, live: Trajectory) -> Trajectory:
    """Return the live poses at the times at which the odometry has one too, to be compared."""
    known = np.isin(live.timestamps_s, given.timestamps_s)
    return Trajectory(live.timestamps_s[known], live.T_world_cam[known])


HEADER = (
    "| sequence | odometry | ATE, m: as it came | live | without loops | with | all poses | loops,"
    " false | what was said |\n|---|---|---|---|---|---|---|---|---|"
)


def table_row(sequence: Sequence, name: str, row: Row) -> str:
    """Run a row and return its line of the table."""
    result, config = run(sequence, row.odometry(sequence), row.settings), Config().evaluation
    true = sequence.ground_truth
    assert true is not None and result.given is not None
    drift = compare_drift(result, true, config)
    live = trajectory_error(_also_in(result.odometry, result.live), true, config).ate_rmse_m
    is_camera = name in ("truth", "own odometry", "drift") or ("_" in name and "base" not in name)
    corrected = "-"
    if is_camera:
        corrected = f"{trajectory_error(result.given.corrected, true, config).ate_rmse_m:.4f}"
    false = sum(bool(loop.is_false) for loop in drift.loops)
    closed = sum(attempt.rejection is None for attempt in result.attempts)
    said = [result.given.verdict, *result.given.warnings]
    errors = (drift.odometry, drift.without_loops, drift.corrected)
    came, without, with_loops = (f"{each.ate_rmse_m:.4f}" for each in errors)
    return (
        f"| {sequence.name} | {name} | {came} | {live:.4f} | {without} | {with_loops} |"
        f" {corrected} | {closed}, {false} | {'; '.join(said)} |"
    )


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sequences", nargs="*", default=SEQUENCES, metavar="SEQUENCE")
    parser.add_argument("--only", nargs="+", metavar="ROW", help="names of rows, or parts of them")
    parser.add_argument("--demo", type=Path, help="folder of the rendered demo, or where to put it")
    parser.add_argument("--out", type=Path, help="file for the table; default: standard output")
    options = parser.parse_args(arguments)
    lines = [HEADER]
    with tempfile.TemporaryDirectory() as scratch:
        for name in options.sequences:
            folder = (options.demo or Path(scratch) / DEMO) if name == DEMO else resolve(name)
            if name == DEMO and not folder.exists():
                render_sequence(folder)
            sequence = open_sequence(folder, Config().input)
            for title, row in rows(sequence, folder):
                if not options.only or any(part in title for part in options.only):
                    lines.append(table_row(sequence, title, row))
                    print(lines[-1], file=sys.stderr)
    text = "\n".join(lines) + "\n"
    if options.out:
        options.out.write_text(text)
    else:
        print(text)


if __name__ == "__main__":
    try:
        main()
    except SlamError as error:
        sys.exit(str(error))
