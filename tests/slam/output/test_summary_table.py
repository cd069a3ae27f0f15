# SPDX-License-Identifier: Apache-2.0
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from placerec.certificate import Certificate
from slam.evaluation.drift import DriftReport, LoopTruth, TrajectoryError
from slam.output.summary import summary_table
from slam.result import Calibration, SlamResult
from slam.types import Camera, LoopAttempt, Rejection, RejectionReason, RelativePose, Trajectory

MOTION = RelativePose(np.eye(4), np.eye(6))
LOW = Rejection(RejectionReason.LOW_SIMILARITY, 0.1, 0.5)
ACCEPTED, OUTVOTED = (LoopAttempt(9, 0, 0.9, None, MOTION, weight) for weight in (1.0, 0.0))
REJECTED = LoopAttempt(9, 4, 0.1, None, LOW)


@pytest.fixture
def result():
    tracked = Trajectory(np.arange(8.0), np.tile(np.eye(4), (8, 1, 1)))
    return SlamResult(
        camera=Camera(640, 480, 525.0, 525.0, 319.5, 239.5),
        keyframes=(),
        T_world_kf=np.zeros((0, 4, 4)),
        odometry=tracked,
        trajectory=tracked,
        links=(),
        attempts=(ACCEPTED, ACCEPTED, OUTVOTED, REJECTED),
        similarities=np.zeros((0, 0), dtype=np.float32),
        min_similarity=0.5,
        untracked_s=np.array([8.0, 9.0]),
        stage_seconds={"read": 0.1, "track": 0.4},
        elapsed_s=0.5,
        warnings=(),
    )


def drift_of(rpe=0.0123, verdicts=(True, False, None, None)):
    before = TrajectoryError(np.zeros(6), np.eye(4), np.zeros(6), 0.05, rpe, 2.0, 0.75)
    after = TrajectoryError(np.zeros(6), np.eye(4), np.zeros(6), 0.02, rpe / 2, 1.0, 0.75)
    loops = tuple(LoopTruth(1.0, 1.0, 1.0, 1.0, verdict) for verdict in verdicts)
    return DriftReport(before, after, loops, 0.02, 0.905, 1.0, 12.5)


def lines(result, drift):
    return summary_table(result, drift, Path("runs/desk")).splitlines()


def test_the_whole_run_in_a_few_lines(result):
    assert lines(result, drift_of()) == [
        "camera     640x480, fx 525, fy 525 px, 5000 depth units per metre",
        "frames     8 of 10 tracked",
        "keyframes  0",
        "recognizer verifies from similarity 0.500, without a certificate",
        "loops      2 accepted of 4 candidates, 1 outvoted by the graph; 1 of 2 checked are false",
        "ATE        0.0500 m -> 0.0200 m corrected",
        "           RMSE over 75.0% of the tracked frames (truth within 20 ms, it covers 90.5%)",
        "           after SE(3) alignment, scale not adjusted",
        "RPE        0.0123 m -> 0.0062 m, 2.00 deg -> 1.00 deg over 1 s",
        "pipeline   20.0 frames/s",
        f"report     {Path('runs/desk/report.html')}",
    ]


def test_a_certificate_is_told_in_one_line(result):
    known = {name: () if "curve" in name else 0 for name in Certificate.model_fields}
    known |= {"recognizer": "w", "fingerprint": "sha256:0", "data": "floors", "pairs": 120}
    known |= {"different_places": (0, 0.5), "same_place": (0, 1), "recall_interval": (0, 1)}
    known |= {"threshold": 0.75, "threshold_interval": (0.625, 0.8), "resampled": "images"}
    certificate = Certificate.model_validate(known)
    certified = replace(result, calibration=Calibration(certificate, np.empty(0, np.float32)))
    (line,) = [line for line in lines(certified, None) if line.startswith("recognizer")]
    assert line == (
        "recognizer verifies from similarity 0.500, calibrated on floors"
        " (120 pairs; tau 0.750, 0.625 to 0.800)"
    )


def test_without_truth_there_is_no_error_and_no_verdict(result):
    text = "\n".join(lines(result, None))
    assert "ATE" not in text and "RPE" not in text and "false" not in text
    assert "2 accepted of 4 candidates, 1 outvoted by the graph\n" in text


def test_an_error_over_an_interval_that_no_frames_are_apart_is_said_to_be_unknown(result):
    text = "\n".join(lines(result, drift_of(rpe=math.nan)))
    assert "RPE        unknown: no two compared frames are 1 s apart" in text
    assert "nan" not in text


def test_nothing_outvoted_and_nothing_judged_goes_unmentioned(result):
    calm = replace(result, attempts=(ACCEPTED, REJECTED))
    assert "loops      1 accepted of 2 candidates" in lines(calm, drift_of(verdicts=(None, None)))


def test_warnings_come_before_the_report(result):
    warned = replace(result, warnings=("The depth looks odd.", "One image is missing."))
    assert lines(warned, None)[-3:] == [
        "warning    The depth looks odd.",
        "warning    One image is missing.",
        f"report     {Path('runs/desk/report.html')}",
    ]


def test_a_run_that_took_no_time_has_no_speed(result):
    assert not any("frames/s" in line for line in lines(replace(result, elapsed_s=0.0), None))
