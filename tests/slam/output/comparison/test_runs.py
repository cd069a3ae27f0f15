# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.config import Config, LoopConfig, MapConfig
from slam.evaluation.comparison import Alignment, ComparisonConfig
from slam.evaluation.drift import compare_drift
from slam.output.comparison.rows import side_by_side
from slam.output.comparison.runs import read_runs
from slam.output.run_folder import write_run
from slam.types import Trajectory

CONFIG = Config(map=MapConfig(write=False))
STRICT = CONFIG.model_copy(update={"loop": LoopConfig(min_similarity=0.5)})
COMMAND = "run_slam path/to/room --recognizer learned"


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    """Folders of three runs, the last one without ground truth."""
    root = tmp_path_factory.mktemp("runs")
    drift = compare_drift(run.result, run.truth, CONFIG.evaluation)
    runs = ("a", CONFIG, drift), ("b", STRICT, drift), ("c", CONFIG, None)
    for name, config, known in runs:
        truth = run.truth if known else None
        write_run(root / name, run.result, known, truth, config, "room", COMMAND)
    return root, drift


def test_errors_of_the_files_are_those_that_the_run_told(written):
    root, drift = written
    (group,) = read_runs([root / "a"])
    found = side_by_side(group, ComparisonConfig())
    told = {row.estimate: row.rmse for row in found.errors}
    assert list(told) == ["odometry", "live", "without loops", "with loops"]
    for estimate, error in (
        ("odometry", drift.odometry),
        ("live", drift.live),
        ("without loops", drift.without_loops),
        ("with loops", drift.corrected),
    ):
        assert told[estimate]["APE (m)"] == pytest.approx(error.ate_rmse_m, abs=1e-8)
        assert told[estimate]["RPE 1 s (m)"] == pytest.approx(error.rpe_translation_m, abs=1e-8)


def test_a_run_of_two_recordings_is_compared_without_the_break_between_them(run, tmp_path):
    stamps_s = run.result.trajectory.timestamps_s
    start_s = stamps_s[len(stamps_s) // 2]

    def parted(path):
        later_s = np.where(path.timestamps_s < start_s - 1e-3, 0.0, 100.0)
        return Trajectory(path.timestamps_s + later_s, path.T_world_cam)

    paths = ("odometry", "live", "without_loops", "trajectory")
    result = replace(
        run.result,
        session_starts_s=np.array([start_s + 100.0]),
        **{name: parted(getattr(run.result, name)) for name in paths},
    )
    truth = parted(run.truth)
    drift = replace(
        run.drift,
        **{
            name: getattr(compare_drift(result, truth, CONFIG.evaluation), name)
            for name in ("coverage", "truth_length_m", "truth")
        },
    )
    write_run(tmp_path / "a", result, drift, truth, CONFIG, "room", COMMAND)
    (group,) = read_runs([tmp_path / "a"])
    rows = side_by_side(group, ComparisonConfig()).errors
    (found,) = [row.comparison.association for row in rows if row.estimate == "odometry"]
    assert found.truth_covers == pytest.approx(drift.coverage, abs=1e-6)
    assert found.truth_length_m == pytest.approx(drift.truth_length_m, abs=1e-6)


def test_what_a_run_told_is_left_out_where_it_was_measured_otherwise(written):
    root, _ = written
    (group,) = read_runs([root / "a"])
    for config in (
        ComparisonConfig(alignment=Alignment.SIM3),
        ComparisonConfig(max_time_difference_s=0.01),
    ):
        found = side_by_side(group, config)
        assert [row.estimate for row in found.errors] == ["odometry", "with loops"]


def test_runs_of_one_sequence_are_a_group_with_what_differs_between_them(written):
    root, _ = written
    (group,) = read_runs([root / "a", root / "b", root / "c"])
    assert group.sequence == "room" and [run.name for run in group.runs] == ["a", "b", "c"]
    assert group.differing == {"loop.min_similarity": ("not told", "0.5", "not told")}
    assert [run.truth is None for run in group.runs] == [False, False, True]


def test_a_run_without_truth_is_as_far_from_another_as_their_poses_are(written):
    root, _ = written
    (group,) = read_runs([root / "c", root / "b"])
    found = side_by_side(group, ComparisonConfig())
    (distance,) = found.distances
    assert (distance.run.name, distance.reference) == ("c", "b")
    assert distance.rmse["APE (m)"] == pytest.approx(0.0, abs=1e-6)
    assert {row.run.name for row in found.errors} == {"b"}
