# SPDX-License-Identifier: Apache-2.0
import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from slam import Config, open_sequence
from slam.demo.recording import render_sequence
from slam.external_odometry.conventions import Convention
from slam.geometry import se3
from slam.types import Camera

pytestmark = pytest.mark.usefixtures("built_rooms")

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "external_odometry.py"
TINY = Camera(160, 120, 131.25, 131.25, 79.5, 59.5)


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("benchmark_of_external_odometry", BENCHMARK)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    folder = tmp_path_factory.mktemp("data") / "tiny"
    render_sequence(folder, seconds=0.8, camera=TINY)
    return open_sequence(folder, Config().input)


def test_each_row_is_the_truth_with_the_one_thing_wrong_that_it_says(benchmark, tiny):
    true = benchmark.truth(tiny)
    rows = {name: row.odometry for name, row in benchmark.MADE_UP.items() if name != "own odometry"}
    made = {name: odometry(tiny) for name, odometry in rows.items()}
    np.testing.assert_array_equal(made["truth"].T_world_cam, tiny.ground_truth.T_world_cam)
    assert len(made["every second pose"]) == (len(true) + 1) // 2
    leap = np.linalg.norm(made["jump of 32 cm"].T_world_cam - true.T_world_cam, axis=(1, 2))
    assert leap[0] == 0.0 and leap[-1] == pytest.approx(0.32, abs=2e-3)
    longer = made["5 % too long"].T_world_cam[:, :3, 3]
    np.testing.assert_allclose(longer, 1.05 * true.T_world_cam[:, :3, 3])
    reading = Convention(T_base_cam=benchmark.T_BASE_CAM)
    seen = reading.camera_poses(made["base_link"])
    np.testing.assert_allclose(seen.T_world_cam, true.T_world_cam, atol=1e-12)
    late = made["150 ms late, auto"].timestamps_s - true.timestamps_s
    np.testing.assert_allclose(late, 0.15)
    inverse = se3.inverse(made["inverted, auto"].T_world_cam)
    np.testing.assert_allclose(inverse, true.T_world_cam, atol=1e-12)
    for name in ("drift", "3 deg and 10 cm per step", "slip over 100 steps"):
        np.testing.assert_array_equal(made[name].T_world_cam[0], true.T_world_cam[0])
        assert np.abs(made[name].T_world_cam[-1] - true.T_world_cam[-1]).max() > 1e-4


def test_a_row_of_the_table_tells_the_errors_and_what_was_said(benchmark, tiny):
    row = benchmark.table_row(tiny, "truth", benchmark.MADE_UP["truth"])
    columns = [each.strip() for each in row.split("|")[1:-1]]
    assert columns[:3] == ["tiny", "truth", "0.0000"] and len(columns) == 9
    assert columns[8].startswith("the odometry, compared with")
