# SPDX-License-Identifier: Apache-2.0
"""How good the map is that three robots with different cameras make of one room, each of its part.

    python -m benchmarks.large_maps.merged_maps [--folder FOLDER] [--recognizer learned]

The rendered demo is cut in three parts in time, each rendered with a camera of its own: other
sizes, focal lengths, a lens that distorts, another unit of depth. Each part is run and saved alone;
then the maps are merged. Prints a line for each map, against the truth, and what joined them. What
was rendered and saved before stays in the folder and is not done again. The exit code is 1 where
the merged map misses the bar, or a loop is false.
"""

import argparse
import sys
import tempfile
from pathlib import Path

import numpy as np

from placerec import load
from placerec.recognizer import PlaceRecognizer
from slam import (
    Camera,
    Config,
    SavedMap,
    Slam,
    Trajectory,
    load_map,
    merge_maps,
    open_sequence,
    read_tum,
    save_map,
    saved_map,
)
from slam.commands.opening import DEFAULT_RECOGNIZER
from slam.demo import LAP_S, render_sequence
from slam.evaluation.drift import trajectory_error
from slam.evaluation.motion_truth import judge_loops

CAMERAS = {
    "kinect": Camera(640, 480, 525.0, 525.0, 319.5, 239.5),
    "small": Camera(480, 360, 430.0, 432.0, 236.0, 183.0),
    "wide": Camera(
        848, 480, 615.0, 614.0, 428.0, 237.0, (0.08, -0.15, 0.001, -0.0005, 0.0), depth_scale=1000.0
    ),
}
SECONDS = 2.0 * LAP_S + 0.5
MOST_ATE_M = 0.008


def mapped(folder: Path, number: int, recognizer: PlaceRecognizer) -> SavedMap:
    """Return the map of one robot's part, rendered, run and saved unless that was done before."""
    name, camera = list(CAMERAS.items())[number]
    first_s, last_s = SECONDS * number / len(CAMERAS), SECONDS * (number + 1) / len(CAMERAS)
    if not (folder / name / "map").exists():
        if not (folder / name / "recording").exists():
            render_sequence(folder / name / "recording", last_s, camera=camera)
        sequence = open_sequence(folder / name / "recording", Config().input)
        slam = Slam(sequence.camera, recognizer)
        for frame in sequence:
            if first_s <= frame.timestamp_s - sequence.timestamps_s[0] < last_s:
                slam.process(frame)
        save_map(folder / name / "map", saved_map(slam, slam.finish()))
    return load_map(folder / name / "map", recognizer)


def ate_m(one: SavedMap, truth: Trajectory) -> float:
    """Return the root mean square error of a map's keyframes, laid on the truth."""
    keyframes = sorted(one.keyframes, key=lambda each: each.timestamp_s)
    found = Trajectory(
        np.array([each.timestamp_s for each in keyframes]),
        np.array([each.T_odom_cam for each in keyframes]),
    )
    return trajectory_error(found, truth, Config().evaluation).ate_rmse_m


def false_loops(one: SavedMap, truth: Trajectory) -> int:
    """Return how many loops in use are off by more than 10 cm or 5 degrees."""
    judged = judge_loops(one.attempts, one.keyframes, truth, Config().evaluation)
    return sum(bool(each.is_false) for each in judged)


def main() -> int:
    """Measure, and return 1 where the merged map misses the bar."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--recognizer", default=DEFAULT_RECOGNIZER)
    asked = parser.parse_args()
    recognizer = load(asked.recognizer)
    with tempfile.TemporaryDirectory() as scratch:
        folder = asked.folder or Path(scratch)
        maps = {name: mapped(folder, number, recognizer) for number, name in enumerate(CAMERAS)}
        truth = read_tum(folder / list(CAMERAS)[-1] / "recording" / "groundtruth.txt")
        merged = merge_maps(maps, recognizer)
        for name, one in {**maps, "merged": merged.the_map}.items():
            print(
                f"{name}: {len(one.keyframes)} keyframes, ATE {1000 * ate_m(one, truth):.1f} mm,"
                f" {len(one.loops)} loops, {false_loops(one, truth)} false"
            )
        for join in merged.joins:
            print(
                f"{' - '.join(join.maps)}: {join.used} loops, of {join.verified} verified and"
                f" {join.candidates} candidates"
            )
        for sentence in (*merged.apart.values(), *merged.warnings):
            print(sentence)
        is_good = ate_m(merged.the_map, truth) <= MOST_ATE_M and not merged.apart
        return 0 if is_good and not false_loops(merged.the_map, truth) else 1


if __name__ == "__main__":
    sys.exit(main())
