# SPDX-License-Identifier: Apache-2.0
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from placerec.certificate import Certificate
from slam.evaluation.drift import DriftReport, TrajectoryError
from slam.evaluation.motion_truth import LoopTruth
from slam.output.summary import summarise, summary_table
from slam.result import Calibration, SlamResult, ThresholdFit
from slam.types import (
    Camera,
    Keyframe,
    Link,
    LoopAttempt,
    Rejection,
    RejectionReason,
    RelativePose,
    Trajectory,
)

TRAJECTORIES = ("odometry", "live", "without_loops", "corrected", "smoothed")
MOTION = RelativePose(np.eye(4), np.eye(6))
ACCEPTED = LoopAttempt(9, 0, 0.9, None, MOTION, 1.0)
OUTVOTED = LoopAttempt(9, 2, 0.9, None, Rejection(RejectionReason.OUTVOTED, 0.0, 0.5), 0.0)
REJECTED = LoopAttempt(9, 4, 0.1, None, Rejection(RejectionReason.LOW_SIMILARITY, 0.1, 0.5))
ATTEMPTS = (ACCEPTED, replace(ACCEPTED, match_id=1), OUTVOTED, OUTVOTED, REJECTED)


def result(attempts=ATTEMPTS, frames=8, stage_seconds=None):
    tracked = Trajectory(np.arange(float(frames)), np.tile(np.eye(4), (frames, 1, 1)))
    return SlamResult(
        camera=Camera(640, 480, 525.0, 525.0, 319.5, 239.5),
        keyframes=(),
        T_world_kf=np.zeros((0, 4, 4)),
        odometry=tracked,
        live=tracked,
        without_loops=tracked,
        trajectory=tracked,
        links=(Link(0, 1, MOTION),),
        attempts=attempts,
        similarities=np.zeros((0, 0), dtype=np.float32),
        min_similarity=0.5,
        untracked_s=np.array([8.0, 9.0]) if frames else np.zeros(0),
        stage_seconds={"read": 0.1, "track": 0.4} if stage_seconds is None else stage_seconds,
        elapsed_s=0.4 if stage_seconds is None else 0.0,  # one stage beside the other
        warnings=("The depth scale looks odd.",),
    )


def drift(rpe_after=(math.nan, math.nan), verdicts=(True, False, None, None, None)):
    def error(ate_m, rpe_m, rpe_deg):
        return TrajectoryError(np.zeros(6), np.eye(4), np.zeros(6), ate_m, rpe_m, rpe_deg, 0.75)

    loops = tuple(LoopTruth(1.0, 1.0, 1.0, 1.0, verdict, 5.0) for verdict in verdicts)
    return DriftReport(
        odometry=error(0.05, 0.03, 2.0),
        live=error(0.04, 0.025, 1.5),
        without_loops=error(0.03, 0.02, 1.2),
        corrected=error(0.02, *rpe_after),
        smoothed=None,
        loops=loops,
        links_nees=np.array([4.0, 8.0, np.nan]),
        tolerance_s=0.02,
        coverage=0.905,
        rpe_interval_s=1.0,
        truth_length_m=12.5,
        truth=Trajectory(np.zeros(0), np.zeros((0, 4, 4))),
    )


@pytest.fixture
def calibration(certificate):
    """Return a function that calibrates on floors."""
    (kind,) = certificate.kinds

    def calibrated(threshold=0.8, **changes):
        found = {"data": "floors", "pairs": 120, "threshold": threshold}
        kinds = {"kinds": (kind.model_copy(update=found),)}
        changed = certificate.model_copy(update=kinds | changes)
        return Calibration(changed, np.empty(0, np.float32))

    return calibrated


def lines(result, drift):
    return summary_table(result, drift, Path("runs/desk")).splitlines()


# summary.json


def test_counts():
    summary = summarise(result(), drift())
    assert (summary["frames_tracked"], summary["frames_untracked"]) == (8, 2)
    assert (summary["keyframes"], summary["links"]) == (0, 1)
    assert summary["loops_tried"] == 5
    assert summary["loops_accepted"] == 2
    assert (summary["loops_verified"], summary["keyframes_with_loop"]) == (0, 1)
    assert summary["loops_outvoted"] == 2
    assert (summary["loops_judged"], summary["loops_false"]) == (2, 1)
    assert summary["warnings"] == ["The depth scale looks odd."]


def test_a_part_of_the_map_that_was_not_joined_is_counted():
    keyframes = tuple(
        Keyframe(k, float(k), np.eye(4), None, None, segment=k // 2) for k in range(5)
    )
    T_world_kf = np.tile(np.eye(4), (5, 1, 1))
    T_world_kf[2:4] = np.nan
    parted = replace(
        result(),
        keyframes=keyframes,
        T_world_kf=T_world_kf,
        unjoined_s=np.array([9.0]),
        session_starts_s=np.array([4.0000004]),
    )
    summary = summarise(parted, None)
    assert (summary["sessions"], summary["segments"]) == (2, 2)
    assert summary["session_starts_s"] == [4.0]  # as the poses' times are written
    assert (summary["frames_untracked"], summary["frames_unjoined"]) == (2, 1)


def test_errors_stand_beside_how_they_were_taken():
    summary = summarise(result(), drift())
    ates = [summary[f"ate_{name}_m"] for name in TRAJECTORIES]
    assert ates == [0.05, 0.04, 0.03, 0.02, None]
    assert summary["rpe_translation_odometry_m"] == 0.03
    assert summary["rpe_rotation_live_deg"] == 1.5
    assert summary["rpe_rotation_without_loops_deg"] == 1.2
    assert summary["rpe_translation_corrected_m"] is summary["rpe_rotation_corrected_deg"] is None
    assert (summary["alignment"], summary["scale"]) == ("SE(3)", 1.0)
    assert (summary["association_tolerance_s"], summary["rpe_interval_s"]) == (0.02, 1.0)
    assert (summary["matched_share"], summary["truth_coverage"]) == (0.75, 0.905)
    assert summary["truth_length_m"] == 12.5
    assert (summary["nees_links_median"], summary["nees_loops_median"]) == (6.0, 5.0)


def test_every_key_is_documented():
    for key in summarise(result(), drift()):
        family = re.sub(rf"_({'|'.join(TRAJECTORIES)})_", "_*_", key)
        assert re.search(rf"\b{re.escape(family)}\b", summarise.__doc__), key


def test_live_frames_without_an_error_are_counted_all_the_same():
    few = replace(result(), live=Trajectory(np.arange(2.0), np.tile(np.eye(4), (2, 1, 1))))
    summary = summarise(few, replace(drift(), live=None))
    assert summary["frames_live"] == 2
    assert summary["ate_live_m"] is summary["rpe_translation_live_m"] is None


def test_what_smoothing_does_stands_apart():
    smoothed = replace(drift(), smoothed=replace(drift().corrected, ate_rmse_m=0.015))
    summary = summarise(result(), smoothed)
    assert (summary["ate_corrected_m"], summary["ate_smoothed_m"]) == (0.02, 0.015)


def test_timings_are_per_frame_whether_tracked_or_not():
    summary = summarise(result(), drift())
    assert summary["frames_per_second"] == pytest.approx(25.0)
    assert summary["stage_seconds"] == {"read": 0.1, "track": 0.4}
    assert summary["stage_ms_per_frame"] == pytest.approx({"read": 10.0, "track": 40.0})


def test_without_truth_or_frames_the_same_keys_are_unknown():
    summary = summarise(result((), frames=0, stage_seconds={}), None)
    assert list(summary) == list(summarise(result(), drift()))
    for name in (
        "ate_odometry_m",
        "ate_live_m",
        "nees_links_median",
        "loops_false",
        "alignment",
        "frames_per_second",
    ):
        assert summary[name] is None
    assert summary["frames_per_second"] is None
    assert summary["stage_ms_per_frame"] == {}


def test_a_threshold_is_told_with_its_reliability():
    assert summarise(result(), None)["threshold"] is None
    adapted = replace(result(), threshold=ThresholdFit(0.5, 0.25, 40, 900, 0.03, np.nan))
    assert summarise(adapted, None)["threshold"] == {
        "adapted": 0.25,
        "one_place_pairs": 40,
        "other_pairs": 900,
        "one_place_cut": 0.03,
        "different_places_passing": None,
    }
    shown = summary_table(adapted, None, Path("out"))
    assert "40 pairs of one place and 900 others met" in shown and "it is 0.250" in shown


def test_certificate_is_told_without_its_curve(calibration):
    assert summarise(result(), None)["certificate"] is None
    assert summarise(result(), None)["min_similarity"] == 0.5
    told = summarise(replace(result(), calibration=calibration()), None)["certificate"]
    thresholds = {"min_similarity", "threshold"}
    assert set(told) == set(Certificate.model_fields) - {"curve"} | thresholds
    assert (told["kinds"][0]["data"], told["fingerprint"]) == ("floors", "sha256:0")
    assert (told["min_similarity"], told["threshold"]) == (0.6, 0.8)
    assert told["threshold_interval"] == [0.7, 0.85]


def test_the_summary_is_plain_json():
    text = json.dumps(summarise(result(), drift()), allow_nan=False)
    assert json.loads(text) == summarise(result(), drift())


# The printed table


def test_the_whole_run_in_a_few_lines():
    calm = replace(result(), warnings=())
    assert lines(calm, drift(rpe_after=(0.0123, 1.0))) == [
        "camera     640x480, fx 525, fy 525 px, 5000 depth units per metre",
        "frames     8 of 10 tracked",
        "keyframes  0",
        "recognizer verifies from similarity 0.500, without a certificate",
        "loops      2 accepted of 5 candidates, 2 outvoted by the graph; 1 of 2 checked are false",
        "ATE        odometry 0.0500 m; live, corrected 0.0400 m",
        "           in the end without loops 0.0300 m, with loops 0.0200 m; not smoothed",
        "           RMSE over 75.0% of the tracked frames (truth within 20 ms, it covers 90.5%)",
        "           after SE(3) alignment, scale not adjusted",
        "RPE        0.0300 m -> 0.0123 m, 2.00 deg -> 1.00 deg over 1 s, odometry -> with loops",
        "NEES       links 6.0, loops 5.0"
        " (medians; 5.35 is right, more: errors are larger than claimed)",
        "pipeline   25.0 frames/s",
        f"report     {Path('runs/desk/report.html')}",
    ]


def test_a_certificate_is_told_in_one_line(calibration):
    certified = calibration(threshold=0.75, threshold_interval=(0.625, 0.8))
    (line,) = [
        line
        for line in lines(replace(result(), calibration=certified), None)
        if line.startswith("recognizer")
    ]
    assert line == (
        "recognizer verifies from similarity 0.500, calibrated on floors"
        " (120 pairs; tau 0.750, 0.625 to 0.800)"
    )


def test_without_truth_there_is_no_error_and_no_verdict():
    text = "\n".join(lines(result(), None))
    assert "ATE" not in text and "RPE" not in text and "false" not in text
    assert "2 accepted of 5 candidates, 2 outvoted by the graph\n" in text
    assert "error      not known: no ground truth to compare with\n" in text


def test_an_error_over_an_interval_that_no_frames_are_apart_is_said_to_be_unknown():
    text = "\n".join(lines(result(), drift()))
    assert "RPE        unknown: no two compared frames are 1 s apart" in text
    assert "nan" not in text


def test_what_ground_truth_cannot_judge_is_said_to_be_unknown():
    unknown = replace(drift(verdicts=(None,) * 5), unjudged="the truth has no orientations")
    printed = lines(result(), unknown)
    assert "RPE        unknown: the truth has no orientations" in printed
    assert not any("false" in line for line in printed)
    summary = summarise(result(), unknown)
    assert (summary["loops_judged"], summary["loops_false"]) == (0, None)


def test_live_figures_of_fewer_frames_say_so():
    few = replace(drift().live, timestamps_s=np.zeros(4))
    text = "\n".join(lines(result(), replace(drift(), live=few)))
    assert "live, corrected 0.0400 m over 4 of 6 frames" in text
    text = "\n".join(lines(result(), replace(drift(), live=None)))
    assert "live, corrected unknown: too few frames" in text


def test_a_smoothed_error_is_named():
    smoothed = replace(drift(), smoothed=replace(drift().corrected, ate_rmse_m=0.015))
    assert "with loops 0.0200 m; not smoothed; smoothed 0.0150 m" in "\n".join(
        lines(result(), smoothed)
    )


def test_nees_without_any_motion_that_truth_covers_is_unknown():
    nothing = drift(verdicts=(None,) * 5)
    text = "\n".join(lines(result(), replace(nothing, links_nees=np.zeros(0))))
    assert "NEES       links unknown, loops unknown" in text


def test_nothing_outvoted_and_nothing_judged_goes_unmentioned():
    table = lines(result((ACCEPTED, REJECTED)), drift(verdicts=(None, None)))
    assert "loops      1 accepted of 2 candidates" in table


def test_warnings_come_before_the_report():
    warned = replace(result(), warnings=("The depth looks odd.", "One image is missing."))
    assert lines(warned, None)[-3:] == [
        "warning    The depth looks odd.",
        "warning    One image is missing.",
        f"report     {Path('runs/desk/report.html')}",
    ]


def test_a_run_that_took_no_time_has_no_speed():
    assert any("frames/s" in line for line in lines(result(), None))
    assert not any("frames/s" in line for line in lines(replace(result(), elapsed_s=0.0), None))


def test_what_the_compiler_took_is_told_beside_the_speed():
    first = replace(result(), compiling_s=0.3)
    assert "pipeline   25.0 frames/s, 0.3 s of compiling included" in lines(first, None)
    assert summarise(first, None)["compiling_s"] == 0.3
