# SPDX-License-Identifier: Apache-2.0
"""The whole pipeline on real recordings, held to what it has to reach there."""

from itertools import islice
from typing import NamedTuple

import pytest

from placerec.gradients import GradientRecognizer
from slam.config import EvaluationConfig, InputConfig
from slam.datasets import open_sequence
from slam.drift import DriftReport, compare_drift
from slam.ledger import write_ledger
from slam.system import Slam
from slam.trajectory import write_tum
from slam.types import SlamResult


class Run(NamedTuple):
    frames: int
    result: SlamResult
    drift: DriftReport


def run(sequence, count=None):
    slam = Slam(sequence.camera, GradientRecognizer())
    for frame in islice(sequence, count):
        slam.process(frame)
    return slam.finish()


def open_recording(data, name):
    folder = data / f"rgbd_dataset_freiburg1_{name}"
    if not folder.is_dir():
        pytest.skip(f"no copy of fr1_{name} in {data} (LOOPCLOSE_DATA)")
    return open_sequence(folder, InputConfig())


def run_all(data, name):
    sequence = open_recording(data, name)
    result = run(sequence)
    drift = compare_drift(
        result.odometry,
        result.trajectory,
        sequence.ground_truth,
        result.attempts,
        result.keyframes,
        EvaluationConfig(),
    )
    return Run(len(sequence), result, drift)


@pytest.fixture(scope="session")
def desk(data):
    return run_all(data, "desk")


@pytest.fixture(scope="session")
def xyz(data):
    return run_all(data, "xyz")


def test_every_frame_of_the_desk_is_tracked_across_the_gap_in_its_fast_turn(desk):
    assert desk.frames == len(desk.result.trajectory) == 595
    assert len(desk.result.untracked_s) == 0


def test_the_drift_on_the_desk(desk):
    assert desk.drift.before.ate_rmse_m <= 0.030
    assert desk.drift.after.ate_rmse_m <= 0.018
    assert desk.drift.after.rpe_translation_m <= 0.025
    assert desk.drift.after.matched_share > 0.99 and desk.drift.coverage > 0.99


def test_the_drift_on_xyz(xyz):
    assert len(xyz.result.untracked_s) == 0
    assert xyz.drift.after.ate_rmse_m <= 0.011


@pytest.mark.parametrize("name", ["desk", "xyz"])
def test_loops_are_closed_and_none_of_them_is_false(name, request):
    verdicts = [loop.is_false for loop in request.getfixturevalue(name).drift.loops]
    assert verdicts.count(False) >= 10
    assert verdicts.count(True) == 0


def test_two_runs_write_the_same_bytes(data, tmp_path):
    for name in ("one", "two"):
        result = run(open_recording(data, "desk"), count=150)
        write_tum(tmp_path / f"{name}.txt", result.trajectory)
        write_ledger(tmp_path / f"{name}.jsonl", result, None)
    for suffix in ("txt", "jsonl"):
        first, second = ((tmp_path / f"{name}.{suffix}").read_bytes() for name in ("one", "two"))
        assert first == second and first
