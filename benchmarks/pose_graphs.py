# SPDX-License-Identifier: Apache-2.0
"""How the pose graph does on public benchmark graphs: prints two Markdown tables.

The first compares the batch optimum with the best one known. The second adds false loops until
they are a given share of all, and counts which loops are kept, beside what kernels make of them.

True loops are the edges of the file between poses that do not follow each other. A false loop ties
two random poses that do not follow each other either, with the information of a random true loop,
and is off by more than 5 % of the map's size. `scattered` claims that the second lies anywhere in
the map (uniform in its box, any orientation), `aliased` that both are the same place, as a fooled
place recognizer does (Gaussian, 0.2 rad and 1 % of the map's size). `clusters` are aliased, too,
but go on for ten poses along two ways that look alike: so many loops agree with each other, as far
as their noise lets them.

The error is that of the positions, aligned, from those of the true loops alone. An answer is wrong
if a false loop was kept, or if it is worse than the odometry. A kernel has no say about loops;
those within the limit are counted as kept.

With `--runs` every run is written to a file as soon as it is done, and those that are there are not
done again: a long table can be stopped, gone on with, or printed anew.
"""

import argparse
import json
import os
import statistics
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam import Config, SlamError
from slam.pose_graph import solve
from slam.pose_graph.batch import factor_errors, optimize, pose_at
from slam.pose_graph.from_g2o import pose_graph_of, rigid
from slam.pose_graph.g2o import read_g2o
from slam.pose_graph.live import squared_error_limit
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
SMALL = ("CSAIL", "smallGrid3D", "kitti_05", "intel")
KINDS = ("scattered", "aliased", "clusters")
IN_A_CLUSTER = 10
INLIER_PROBABILITY = Config().graph.inlier_probability
OWN = "loopclose"
_ESTIMATORS = gtsam.noiseModel.mEstimator
KERNELS = {
    "least squares": None,
    "Huber": _ESTIMATORS.Huber,
    "Cauchy": _ESTIMATORS.Cauchy,
    "DCS": _ESTIMATORS.DCS,
    "Geman-McClure": _ESTIMATORS.GemanMcClure,
}


@dataclass(frozen=True)
class Problem:
    """A benchmark graph: factors, the odometry's poses, the best ones, and which are loops."""

    graph: gtsam.NonlinearFactorGraph
    chain: gtsam.Values
    optimum: gtsam.Values
    loops: list[int]


@dataclass(frozen=True)
class Stress:
    """What was made of a graph with false loops; errors in the graph's metres."""

    true_kept: int
    true_count: int
    false_kept: int
    false_count: int
    error_m: float
    without_m: float
    warnings: tuple[str, ...]
    seconds: float

    @property
    def is_wrong(self) -> bool:
        """Whether a false loop was kept, or no loop at all would have been better."""
        return self.false_kept > 0 or self.error_m > self.without_m + 1e-6

    @property
    def precision(self) -> float:
        """Of what was kept; 1 if nothing was."""
        kept = self.true_kept + self.false_kept
        return self.true_kept / kept if kept else 1.0

    @property
    def recall(self) -> float:
        """Of the true loops."""
        return self.true_kept / self.true_count


class Runs:
    """What runs came to, by graph, kind, share, seed and estimator; in a file if there is one."""

    def __init__(self, path: Path | None) -> None:
        self._path = path
        self.done: dict[tuple[object, ...], Stress] = {}
        if path and path.is_file():
            for line in path.read_text(encoding="utf-8").splitlines():
                run, stress = json.loads(line)
                self.done[tuple(run)] = Stress(**stress)

    def add(self, run: tuple[object, ...], stress: Stress) -> None:
        """Keep a run, at once."""
        self.done[run] = stress
        if self._path:
            with self._path.open("a", encoding="utf-8") as file:
                file.write(json.dumps([run, asdict(stress)]) + "\n")


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
    optimum = optimize(graph, chain)
    return Problem(graph, chain, optimum, list(range(graph.size() - len(loops), graph.size())))


def add_false_loops(problem: Problem, kind: str, share: float, seed: int) -> Problem:
    """Return the graph with random false loops after the true ones; `share` is of all loops."""
    rng = np.random.default_rng(seed)
    graph, optimum = problem.graph.clone(), problem.optimum
    keys = list(optimum.keys())
    positions = np.array([pose_at(optimum, key).translation() for key in keys])
    extent = positions.max(axis=0) - positions.min(axis=0)
    wanted = graph.size() + round(len(problem.loops) * share / (1.0 - share))
    length = IN_A_CLUSTER if kind == "clusters" else 1
    while graph.size() < wanted:
        model: Any = graph.at(int(rng.choice(problem.loops)))
        first, second = sorted(rng.choice(len(keys) - length + 1, 2, replace=False).tolist())
        true_motion = pose_at(optimum, first).between(pose_at(optimum, second))
        if kind == "scattered":
            motion = pose_at(optimum, first).between(_anywhere(rng, positions.min(axis=0), extent))
        else:
            motion = _nearby(rng, len(extent), 0.01 * extent.max())
        error = np.linalg.norm(motion.translation() - true_motion.translation())
        if second - first <= length or error <= 0.05 * extent.max():
            continue
        for i in range(min(length, wanted - graph.size())):
            onwards = motion.compose(_motion(optimum, second, second + i))
            claimed = _motion(optimum, first + i, first).compose(onwards)
            if length > 1:
                model = graph.at(int(rng.choice(problem.loops)))
                noise = model.noiseModel().covariance()
                off = rng.multivariate_normal(np.zeros(len(noise)), noise)
                claimed = claimed.compose(type(claimed).Expmap(off))
            graph.add(type(model)(first + i, second + i, claimed, model.noiseModel()))
    loops = list(range(problem.loops[0], graph.size()))
    return Problem(graph, problem.chain, optimum, loops)


def stress(problem: Problem, spoilt: Problem) -> Stress:
    """Solve a problem spoilt by false loops and count what is kept."""
    first = spoilt.loops[0]
    factors = gtsam.NonlinearFactorGraph()
    for i in range(1, spoilt.graph.size()):  # without the anchor
        factors.add(spoilt.graph.at(i))
    graph = pose_graph_of(factors, "the benchmark")
    start = time.perf_counter()
    solution = solve(graph, INLIER_PROBABILITY)
    seconds = time.perf_counter() - start
    kept = np.array([solution.weights[i - 1] > MIN_TRUSTED_WEIGHT for i in spoilt.loops])
    assert len(kept) == spoilt.graph.size() - first
    positions = np.array([T[:3, 3] for T in solution.T_world_kf.values()])
    return _judged(problem, kept, positions, solution.warnings, seconds)


def stress_kernel(problem: Problem, spoilt: Problem, name: str) -> Stress:
    """Return the same of least squares or of a kernel on all loops, from the odometry."""
    limit = squared_error_limit(INLIER_PROBABILITY, problem.graph.at(1).dim() == 3)
    start = time.perf_counter()
    if make := KERNELS[name]:
        softened = spoilt.graph.clone()
        kernel = make(float(np.sqrt(limit)))
        for i in spoilt.loops:
            factor: Any = spoilt.graph.at(i)
            noise = gtsam.noiseModel.Robust.Create(kernel, factor.noiseModel())
            softened.replace(i, factor.cloneWithNewNoiseModel(noise))
        values = gtsam.LevenbergMarquardtOptimizer(softened, spoilt.chain).optimize()
    else:
        values = gtsam.LevenbergMarquardtOptimizer(spoilt.graph, spoilt.chain).optimize()
    seconds = time.perf_counter() - start
    kept = 2.0 * factor_errors(spoilt.graph, values)[spoilt.loops] < limit
    return _judged(problem, kept, _positions(values), (), seconds)


def _judged(
    problem: Problem,
    kept: NDArray[np.bool_],
    positions: FloatArray,
    warnings: tuple[str, ...],
    seconds: float,
) -> Stress:
    truth = _positions(problem.optimum)
    error_m, without_m = (_error_m(each, truth) for each in (positions, _positions(problem.chain)))
    count = len(problem.loops)
    true_kept, false_kept = int(kept[:count].sum()), int(kept[count:].sum())
    counts = (true_kept, count, false_kept, len(kept) - count)
    return Stress(*counts, error_m, without_m, warnings, seconds)


def _positions(values: gtsam.Values) -> FloatArray:
    return np.array([rigid(values, key)[:3, 3] for key in sorted(values.keys())])


def _error_m(estimate: FloatArray, truth: FloatArray) -> float:
    """Return the root mean square distance of (N, 3) positions, rigidly aligned."""
    a, b = estimate - estimate.mean(axis=0), truth - truth.mean(axis=0)
    U, _, Vt = np.linalg.svd(a.T @ b)
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt)) or 1.0])
    return float(np.sqrt(((a @ (U @ flip @ Vt) - b) ** 2).sum(axis=1).mean()))


def _motion(values: gtsam.Values, first: int, second: int) -> Any:
    return pose_at(values, first).between(pose_at(values, second))


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


def print_stress(
    folder: Path,
    names: Sequence[str],
    cases: Sequence[tuple[str, float]],
    seeds: int,
    kernels: Sequence[str],
    runs: Runs,
) -> None:
    """Print the table of the false-loop test, a line for each graph, kind and share."""
    columns = (
        "graph | false loops | share | precision, worst | recall, median (worst) | error, median "
        "(worst) | without loops | wrong, of these warned | right, but warned | seconds, median"
    )
    columns = " | ".join([columns, *kernels])
    print(f"| {columns} |\n|{'---|' * (columns.count('|') + 1)}")
    for name in names:
        problem = load_problem(folder / f"{name}.g2o")
        for kind, share in cases:
            estimate = partial(_stresses, problem, (name, kind, share), seeds, runs)
            cells = _cells(estimate(OWN))
            cells += [f"{statistics.median(r.error_m for r in estimate(k)):.3f}" for k in kernels]
            print(f"| {name} | {kind} | {share:.0%} | {' | '.join(cells)} |", flush=True)


def _stresses(
    problem: Problem, case: tuple[str, str, float], seeds: int, runs: Runs, estimator: str
) -> list[Stress]:
    """Return what an estimator makes of a graph, kind and share of false loops, by seed."""
    found = []
    for seed in range(seeds):
        run = (*case, seed, estimator)
        if run not in runs.done:
            spoilt = add_false_loops(problem, *case[1:], seed)
            if estimator == OWN:
                runs.add(run, stress(problem, spoilt))
            else:
                runs.add(run, stress_kernel(problem, spoilt, estimator))
        found.append(runs.done[run])
    return found


def _cells(runs: Sequence[Stress]) -> list[str]:
    recalls, errors_m = [run.recall for run in runs], [run.error_m for run in runs]
    wrong = [run for run in runs if run.is_wrong]
    return [
        f"{min(run.precision for run in runs):.3f}",
        f"{statistics.median(recalls):.3f} ({min(recalls):.3f})",
        f"{statistics.median(errors_m):.3f} ({max(errors_m):.3f})",
        f"{runs[0].without_m:.3f}",
        f"{len(wrong)}, {sum(bool(run.warnings) for run in wrong)}",
        f"{sum(bool(run.warnings) and not run.is_wrong for run in runs)} of {len(runs)}",
        f"{statistics.median(run.seconds for run in runs):.1f}",
    ]


def main() -> None:
    """Read the command line and print the tables."""
    data = Path(os.environ.get("LOOPCLOSE_DATA", Path(__file__).parents[2] / "shared" / "data"))
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument(
        "--data", type=Path, default=data / "pose_graphs", help="folder of .g2o files"
    )
    parser.add_argument("--graphs", nargs="+", default=list(SMALL), choices=list(REFERENCES))
    parser.add_argument("--kinds", nargs="+", default=list(KINDS), choices=KINDS)
    parser.add_argument(
        "--shares",
        type=float,
        nargs="+",
        default=[0.1, 0.3, 0.5, 0.8],
        help="of all loops, to 0.95",
    )
    parser.add_argument("--seeds", type=int, default=5, help="runs per line of the second table")
    parser.add_argument(
        "--kernels", nargs="*", default=list(KERNELS), choices=list(KERNELS), help="to compare with"
    )
    parser.add_argument("--runs", type=Path, help="file of the runs that are done, to go on with")
    arguments = parser.parse_args()
    if not all(0.0 <= share <= 0.95 for share in arguments.shares):
        parser.error(f"--shares {arguments.shares}: allowed is 0 to 0.95")
    try:
        print_optima(arguments.data, arguments.graphs)
        print()
        cases = [(kind, share) for kind in arguments.kinds for share in arguments.shares]
        chosen = (cases, arguments.seeds, arguments.kernels, Runs(arguments.runs))
        print_stress(arguments.data, arguments.graphs, *chosen)
    except SlamError as error:
        parser.exit(2, f"{error}\n")


if __name__ == "__main__":
    main()
