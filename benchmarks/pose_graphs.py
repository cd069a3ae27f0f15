# SPDX-License-Identifier: Apache-2.0
"""How the pose graph does on public benchmark graphs: prints two Markdown tables.

The first compares the batch optimum with the best one known. The second adds false loops until
they are a given share of all, and counts which loops the robust solver keeps.

True loops are the edges of the file between poses that do not follow each other. A false loop ties
two random poses that do not follow each other either, with the information of a random true loop,
and is off by more than 5 % of the map's size. `scattered` claims that the second lies anywhere in
the map (uniform in its box, any orientation), `aliased` that both are the same place, as a fooled
place recognizer does (Gaussian, 0.2 rad and 1 % of the map's size).
"""

import argparse
import os
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import gtsam
import numpy as np

from slam import Config, SlamError
from slam.pose_graph.batch import optimize, pose_at
from slam.pose_graph.g2o import read_g2o
from slam.pose_graph.robust import contested_motions, doubts, solve_robustly
from slam.types import MIN_TRUSTED_WEIGHT, FloatArray

# Half chi-square of the best optima known.
REFERENCES = {
    "CSAIL": 20.2754,
    "intel": 22.5021,
    "kitti_05": 78.552,
    "smallGrid3D": 517.925,
    "sphere2500": 675.701,
    "torus3D": 12117.64,
}
STRESSED = ("CSAIL", "smallGrid3D", "kitti_05")
KINDS = ("scattered", "aliased")
INLIER_PROBABILITY = Config().graph.inlier_probability


@dataclass(frozen=True)
class Problem:
    """A benchmark graph: factors, the odometry's poses, and which factors are loops."""

    graph: gtsam.NonlinearFactorGraph
    chain: gtsam.Values
    loops: list[int]


@dataclass(frozen=True)
class Stress:
    """What the robust solver made of a graph with false loops."""

    true_kept: int
    true_count: int
    false_kept: int
    false_count: int
    warnings: tuple[str, ...]
    seconds: float


def load_problem(path: Path) -> Problem:
    """Read a g2o file: anchored at its first pose, loops last, poses chained from odometry."""
    factors: Any = read_g2o(path)[0]
    factors = [factors.at(i) for i in range(factors.size())]
    odometry = [each for each in factors if abs(np.diff(each.keys())[0]) == 1]
    loops = [each for each in factors if abs(np.diff(each.keys())[0]) != 1]
    is_flat = factors[0].dim() == 3
    pose: Any = gtsam.Pose2() if is_flat else gtsam.Pose3()
    prior: Any = gtsam.PriorFactorPose2 if is_flat else gtsam.PriorFactorPose3
    graph, chain = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(prior(0, pose, gtsam.noiseModel.Isotropic.Sigma(factors[0].dim(), 1e-4)))
    chain.insert(0, pose)
    for factor in odometry:
        graph.add(factor)
        first, second = factor.keys()
        if second == first + 1 and not chain.exists(second):
            chain.insert(second, pose_at(chain, first).compose(factor.measured()))
    for factor in loops:
        graph.add(factor)
    return Problem(graph, chain, list(range(graph.size() - len(loops), graph.size())))


def add_false_loops(problem: Problem, kind: str, share: float, seed: int) -> Problem:
    """Return the graph with random false loops after the true ones; `share` is of all loops."""
    rng = np.random.default_rng(seed)
    graph = problem.graph.clone()
    optimum = optimize(graph, problem.chain)
    keys = list(optimum.keys())
    positions = np.array([pose_at(optimum, key).translation() for key in keys])
    extent = positions.max(axis=0) - positions.min(axis=0)
    wanted = graph.size() + round(len(problem.loops) * share / (1.0 - share))
    while graph.size() < wanted:
        model: Any = graph.at(int(rng.choice(problem.loops)))
        first, second = sorted(rng.choice(keys, 2, replace=False).tolist())
        true_motion = pose_at(optimum, first).between(pose_at(optimum, second))
        if kind == "scattered":
            motion = pose_at(optimum, first).between(_anywhere(rng, positions.min(axis=0), extent))
        else:
            motion = _nearby(rng, len(extent), 0.01 * extent.max())
        error = np.linalg.norm(motion.translation() - true_motion.translation())
        if second - first > 1 and error > 0.05 * extent.max():
            graph.add(type(model)(first, second, motion, model.noiseModel()))
    return Problem(graph, problem.chain, list(range(problem.loops[0], graph.size())))


def stress(problem: Problem, kind: str, share: float, seed: int) -> Stress:
    """Weigh true and false loops and count what is kept."""
    spoilt = add_false_loops(problem, kind, share, seed)
    start = time.perf_counter()
    solution = solve_robustly(spoilt.graph, spoilt.chain, spoilt.loops, INLIER_PROBABILITY)
    contested = contested_motions(spoilt.graph, spoilt.chain, spoilt.loops, solution)
    seconds = time.perf_counter() - start
    kept = solution.weights[spoilt.loops] > MIN_TRUSTED_WEIGHT
    count = len(problem.loops)
    true_kept, false_kept = int(kept[:count].sum()), int(kept[count:].sum())
    return Stress(true_kept, count, false_kept, len(kept) - count, doubts(kept, contested), seconds)


def _anywhere(rng: np.random.Generator, corner: FloatArray, extent: FloatArray) -> Any:
    position = corner + rng.uniform(size=len(extent)) * extent
    if len(position) == 2:
        return gtsam.Pose2(position[0], position[1], rng.uniform(-np.pi, np.pi))
    quaternion = rng.normal(size=4)
    rotation = gtsam.Rot3.Quaternion(*(quaternion / np.linalg.norm(quaternion)))
    return gtsam.Pose3(rotation, position)


def _nearby(rng: np.random.Generator, dimension: int, sigma_m: float) -> Any:
    position = sigma_m * rng.normal(size=dimension)
    if dimension == 2:
        return gtsam.Pose2(position[0], position[1], 0.2 * rng.normal())
    return gtsam.Pose3(gtsam.Rot3.Expmap(0.2 * rng.normal(size=3)), position)


def print_optima(folder: Path, names: list[str]) -> None:
    """Print the table of batch optima."""
    print("| graph | poses | edges | best known | reached | difference | seconds |")
    print("|---|---|---|---|---|---|---|")
    for name in names:
        problem = load_problem(folder / f"{name}.g2o")
        start = time.perf_counter()
        error = problem.graph.error(optimize(problem.graph, problem.chain))
        seconds = time.perf_counter() - start
        difference = (error / REFERENCES[name] - 1.0) * 100.0
        print(
            f"| {name} | {problem.chain.size()} | {problem.graph.size() - 1} | {REFERENCES[name]} "
            f"| {error:.3f} | {difference:+.4f} % | {seconds:.2f} |",
            flush=True,
        )


def print_stress(folder: Path, names: list[str], share: float, seeds: int) -> None:
    """Print the table of the false-loop test."""
    print("| graph | false loops | share | false kept, worst | true kept, median (worst) ", end="")
    print("| runs with a warning | seconds, median |")
    print("|---|---|---|---|---|---|---|")
    for name in names:
        problem = load_problem(folder / f"{name}.g2o")
        for kind in KINDS:
            runs = [stress(problem, kind, share, seed) for seed in range(seeds)]
            recalls = [100.0 * run.true_kept / run.true_count for run in runs]
            print(
                f"| {name} | {kind} | {share:.0%} "
                f"| {max(run.false_kept for run in runs)} of {runs[0].false_count} "
                f"| {statistics.median(recalls):.1f} % ({min(recalls):.1f} %) "
                f"| {sum(bool(run.warnings) for run in runs)} of {seeds} "
                f"| {statistics.median(run.seconds for run in runs):.2f} |",
                flush=True,
            )


def main() -> None:
    """Read the command line and print the tables."""
    data = Path(os.environ.get("LOOPCLOSE_DATA", Path(__file__).parents[2] / "shared" / "data"))
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument(
        "--data", type=Path, default=data / "pose_graphs", help="folder of .g2o files"
    )
    parser.add_argument("--graphs", nargs="+", default=list(REFERENCES), choices=list(REFERENCES))
    parser.add_argument("--share", type=float, default=0.5, help="false loops among all, 0 to 0.95")
    parser.add_argument("--seeds", type=int, default=5, help="runs per line of the second table")
    arguments = parser.parse_args()
    if not 0.0 <= arguments.share <= 0.95:
        parser.error(f"--share {arguments.share}: allowed is 0 to 0.95")
    try:
        print_optima(arguments.data, arguments.graphs)
        print()
        names = [name for name in arguments.graphs if name in STRESSED]
        print_stress(arguments.data, names, arguments.share, arguments.seeds)
    except SlamError as error:
        parser.exit(2, f"{error}\n")


if __name__ == "__main__":
    main()
