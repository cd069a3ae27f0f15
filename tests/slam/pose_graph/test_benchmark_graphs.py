# SPDX-License-Identifier: Apache-2.0
"""The published graphs; `benchmarks/pose_graphs.py` measures the large ones and more seeds."""

import importlib.util
import os
from pathlib import Path
from types import ModuleType

import pytest

from slam.pose_graph.batch import optimize

ROOT = Path(__file__).parents[3]
GRAPHS = Path(os.environ.get("LOOPCLOSE_DATA", ROOT.parent / "shared" / "data")) / "pose_graphs"

pytestmark = pytest.mark.skipif(not GRAPHS.is_dir(), reason=f"no benchmark graphs at {GRAPHS}")


@pytest.fixture(scope="module")
def benchmark() -> ModuleType:
    path = ROOT / "benchmarks" / "pose_graphs.py"
    spec = importlib.util.spec_from_file_location("pose_graphs_benchmark", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("name", ["CSAIL", "intel", "kitti_05", "smallGrid3D"])
def test_the_best_known_optimum_is_reached(benchmark: ModuleType, name: str) -> None:
    problem = benchmark.load_problem(GRAPHS / f"{name}.g2o")
    error = problem.graph.error(optimize(problem.graph, problem.chain))
    assert error == pytest.approx(benchmark.REFERENCES[name], rel=1e-3)


@pytest.mark.parametrize(
    ("name", "kind", "share", "recall"),
    [
        ("CSAIL", "scattered", 0.5, 0.98),
        ("CSAIL", "clusters", 0.8, 0.98),
        ("smallGrid3D", "scattered", 0.5, 0.98),
        ("smallGrid3D", "clusters", 0.5, 0.98),
        ("kitti_05", "aliased", 0.5, 0.90),
    ],
)
def test_many_of_the_loops_may_be_false(
    benchmark: ModuleType, name: str, kind: str, share: float, recall: float
) -> None:
    problem = benchmark.load_problem(GRAPHS / f"{name}.g2o")
    spoilt = benchmark.add_false_loops(problem, kind, share, seed=0)
    result = benchmark.stress(problem, spoilt)
    assert result.false_count == round(result.true_count * share / (1.0 - share))
    assert result.false_kept == 0 and not result.is_wrong
    assert result.recall >= recall
    assert result.error_m < 0.1 * result.without_m


def test_a_kernel_is_judged_as_the_graph_is(benchmark: ModuleType) -> None:
    problem = benchmark.load_problem(GRAPHS / "smallGrid3D.g2o")
    spoilt = benchmark.add_false_loops(problem, "clusters", 0.5, seed=0)
    least_squares = benchmark.stress_kernel(problem, spoilt, "least squares")
    assert least_squares.error_m > 1.0
    undisturbed = benchmark.stress_kernel(problem, problem, "least squares")
    assert undisturbed.error_m < 0.01 and undisturbed.false_count == 0
