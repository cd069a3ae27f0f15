# SPDX-License-Identifier: Apache-2.0
"""The picture at the top of the README, drawn from the folder of a real run with ground truth.

run_slam fr1_desk
python benchmarks/readme_picture.py runs/fr1_desk docs/images/fr1_desk.svg
"""

import argparse
import sys
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes

from placerec.errors import LoopcloseError
from placerec.evaluation.drawing import AFTER, BEFORE, TRUTH, canvas, png, svg
from slam import read_tum
from slam.config import load_config
from slam.evaluation.drift import TrajectoryError, trajectory_error
from slam.evaluation.trajectory import associate
from slam.geometry import se3
from slam.output.ledger.reading import read_ledger
from slam.types import FloatArray

ESTIMATES = {"odometry": BEFORE, "corrected": AFTER}


def draw(run: Path, picture: Path) -> None:
    """Draw paths and position errors before and after loop closure.

    Raises:
        LoopcloseError: the folder does not hold a run with ground truth.
    """
    evaluation = load_config(run / "settings.toml").evaluation
    truth = read_tum(run / "groundtruth.txt")
    before, after = read_tum(run / "odometry.txt"), read_tum(run / "trajectory.txt")
    errors = [trajectory_error(estimate, truth, evaluation) for estimate in (before, after)]
    paths_m = [
        se3.transform(error.T_truth_world, estimate.T_world_cam[:, :3, 3])
        for estimate, error in zip((before, after), errors, strict=True)
    ]
    _, in_truth = associate(before, truth, evaluation.max_time_difference_s)
    loops_s = [loop.query_timestamp_s for loop in read_ledger(run / "loops.jsonl") if loop.accepted]
    with canvas(3.5, 9.0) as figure:
        left, right = figure.subplots(1, 2, width_ratios=(1.2, 1.0))
        _draw_paths(left, truth.T_world_cam[in_truth, :3, 3], paths_m)
        _draw_errors(right, errors, np.unique(loops_s))
    picture.write_bytes(svg(figure) if picture.suffix == ".svg" else png(figure))


def _draw_paths(axes: Axes, truth_m: FloatArray, paths_m: list[FloatArray]) -> None:
    across, up = np.argsort(-np.ptp(truth_m, axis=0))[:2]
    axes.plot(
        truth_m[:, across], truth_m[:, up], color=TRUTH, alpha=0.5, lw=3.5, label="ground truth"
    )
    for (label, colour), path_m in zip(ESTIMATES.items(), paths_m, strict=True):
        axes.plot(path_m[:, across], path_m[:, up], color=colour, lw=1.1, label=label)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{'xyz'[across]} (m)", ylabel=f"{'xyz'[up]} (m)")
    axes.legend(loc="upper left", ncols=3)


def _draw_errors(axes: Axes, errors: list[TrajectoryError], loops_s: FloatArray) -> None:
    start_s = errors[0].timestamps_s[0]
    for (label, colour), error in zip(ESTIMATES.items(), errors, strict=True):
        times_s = error.timestamps_s - start_s
        label = f"{label}, ATE {100 * error.ate_rmse_m:.1f} cm"
        axes.plot(times_s, 100 * error.position_errors_m, color=colour, lw=1.3, label=label)
    axes.plot(loops_s - start_s, 0 * loops_s, "^", color=AFTER, clip_on=False, label="loop closed")
    axes.set(xlabel="time (s)", ylabel="position error (cm)")
    axes.set_ylim(0.0, 1.25 * axes.get_ylim()[1])  # space for the legend
    axes.legend(loc="upper right")


def main(arguments: list[str] | None = None) -> int:
    """Draw the picture; return 2 where the run does not hold what is needed."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("run", type=Path, help="folder that run_slam wrote")
    parser.add_argument("picture", type=Path, help="SVG or PNG file to write")
    parsed = parser.parse_args(arguments)
    try:
        draw(parsed.run, parsed.picture)
    except LoopcloseError as error:
        print(f"readme_picture: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
