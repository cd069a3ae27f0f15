# SPDX-License-Identifier: Apache-2.0
import json
import math
from dataclasses import replace

import numpy as np
import pytest

from slam.evaluation.drift import DriftReport, TrajectoryError
from slam.evaluation.motion_truth import LoopTruth
from slam.geometry import se3
from slam.output.ledger.reading import read_ledger
from slam.output.ledger.records import MotionRecord, TruthRecord
from slam.output.ledger.writing import loop_records, renumbered, write_ledger
from slam.result import SlamResult
from slam.types import (
    Camera,
    Check,
    Features,
    Frame,
    Keyframe,
    LoopAttempt,
    Proposal,
    Rejection,
    RejectionReason,
    RelativePose,
    SlamError,
    Trajectory,
    Verification,
)

NAN = math.nan
MOTION = RelativePose(
    se3.exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, 3.0])),
    np.arange(36.0).reshape(6, 6) + np.arange(36.0).reshape(6, 6).T + 1.0 / 3.0,
)
FEW = Rejection(RejectionReason.FEW_INLIERS, 12.0, 25.0)
OUTVOTED = Rejection(RejectionReason.OUTVOTED, 0.0, 0.5)


def verification(outcome):
    return Verification(outcome, np.zeros((40, 4)), np.arange(40) < 12, np.zeros((40, 3)))


ATTEMPTS = (
    LoopAttempt(2, 0, 0.9, verification(MOTION), MOTION, 0.75),
    LoopAttempt(2, 1, 0.8, verification(FEW), FEW),
    LoopAttempt(1, 0, 0.1, None, Rejection(RejectionReason.LOW_SIMILARITY, 0.1, 0.5)),
    LoopAttempt(1, 0, 0.7, verification(MOTION), OUTVOTED, 0.0),
)
CONDITIONS = {
    "tolerance_s": 0.02,
    "coverage": 1.0,
    "rpe_interval_s": 1.0,
    "truth_length_m": 5.0,
    "truth": Trajectory(np.zeros(0), np.zeros((0, 4, 4))),
}
TRUTHS = (
    LoopTruth(0.01, 0.5, 1.0, 20.0, False, 5.5),
    LoopTruth(NAN, NAN, 2.0, 30.0, None),
    LoopTruth(NAN, NAN, NAN, NAN, None),
    LoopTruth(4.0, 50.0, 1.0, 20.0, None),
)


def keyframe(index):
    stamp_s = 1305031449.7996 + index
    nothing, points = np.zeros((0, 2)), np.zeros((0, 3))
    features = Features(
        nothing,
        nothing,
        np.zeros(0, dtype=np.int64),
        np.zeros((0, 32), dtype=np.uint8),
        np.zeros(0),
        points,
    )
    preview = Frame(
        stamp_s, np.zeros((1, 1, 3), dtype=np.uint8), np.zeros((1, 1), dtype=np.float32)
    )
    return Keyframe(index, stamp_s, np.eye(4), features, preview)


def result(attempts=ATTEMPTS):
    nothing = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    return SlamResult(
        camera=Camera(640, 480, 525.0, 525.0, 319.5, 239.5),
        keyframes=tuple(keyframe(index) for index in range(3)),
        T_world_kf=np.tile(np.eye(4), (3, 1, 1)),
        odometry=nothing,
        live=nothing,
        without_loops=nothing,
        trajectory=nothing,
        links=(),
        attempts=attempts,
        similarities=np.zeros((3, 3), dtype=np.float32),
        min_similarity=0.5,
        untracked_s=np.zeros(0),
        stage_seconds={},
        warnings=(),
    )


def drift(loops=TRUTHS):
    error = TrajectoryError(np.zeros(3), np.eye(4), np.zeros(3), 0.0, 0.0, 0.0, 1.0)
    errors = dict.fromkeys(("odometry", "live", "without_loops", "corrected", "smoothed"), error)
    return DriftReport(**errors, loops=loops, links_nees=np.zeros(0), **CONDITIONS)


def test_round_trip(tmp_path):
    path = tmp_path / "loops.jsonl"
    for report in (None, drift()):
        write_ledger(path, result(), report)
        assert read_ledger(path) == loop_records(result(), report)
    write_ledger(path, result(attempts=()), None)
    assert path.read_bytes() == b""
    assert read_ledger(path) == ()


def test_last_bits_do_not_change_the_bytes(tmp_path):
    nudged = RelativePose(MOTION.T_ref_query * (1.0 + 1e-14), MOTION.information * (1.0 - 1e-14))
    again = LoopAttempt(2, 0, 0.9 + 1e-15, verification(nudged), nudged, 0.75)
    write_ledger(tmp_path / "a", result(ATTEMPTS[:1]), None)
    write_ledger(tmp_path / "b", result((again,)), None)
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()


def test_an_accepted_loop_carries_its_motion_and_its_truth():
    record = loop_records(result(), drift())[0]
    assert (record.query_id, record.match_id, record.weight) == (2, 0, 0.75)
    assert record.query_timestamp_s == 1305031451.7996
    assert record.match_timestamp_s == 1305031449.7996
    assert record.accepted
    assert record.reason is record.explanation is record.measured is record.margin is None
    assert (record.matches, record.inliers) == (40, 12)
    motion = record.T_match_query
    assert isinstance(motion, MotionRecord)
    T_match_query = se3.from_rotation_translation(
        se3.from_quaternion(np.array(motion.quaternion_xyzw)), np.array(motion.translation_m)
    )
    np.testing.assert_allclose(T_match_query, MOTION.T_ref_query, atol=1e-8)
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = motion.information
    np.testing.assert_allclose(upper, np.triu(MOTION.information), rtol=1e-8)
    assert record.truth == TruthRecord(0.01, 0.5, 1.0, 20.0, False, 5.5)


def test_a_rejected_loop_says_why_and_how_far_it_was_from_being_accepted():
    record = loop_records(result(), drift())[1]
    assert not record.accepted
    assert record.reason == "few_inliers"
    assert record.explanation == RejectionReason.FEW_INLIERS.value
    assert (record.measured, record.needed, record.margin) == (12.0, 25.0, 13.0)
    assert record.T_match_query is record.weight is None
    assert record.truth == TruthRecord(None, None, 2.0, 30.0, None, None)


def test_a_loop_below_the_threshold_was_never_shown_to_geometry():
    record = loop_records(result(), drift())[2]
    assert (record.similarity, record.min_similarity) == (0.1, 0.5)
    assert record.matches is record.inliers is record.truth is None


def test_a_decision_has_the_threshold_that_applied_then():
    found = result()
    first, *others = found.attempts
    found = replace(found, attempts=(replace(first, min_similarity=0.25), *others))
    assert [record.min_similarity for record in loop_records(found, None)] == [0.25, 0.5, 0.5, 0.5]


def test_a_loop_the_graph_ignores_is_outvoted_but_keeps_its_motion():
    record = loop_records(result(), drift())[3]
    assert not record.accepted
    assert (record.reason, record.weight) == ("outvoted", 0.0)
    assert record.T_match_query is not None


STAGES = (
    Check(RejectionReason.LOW_SIMILARITY, 0.9, 0.5, passed=True),
    Check(RejectionReason.FEW_MATCHES, 40, 20, passed=True),
    Check(RejectionReason.FEW_INLIERS, 12.0, 25.0, passed=False),
    Check(RejectionReason.LOW_INLIER_RATIO, 0.3, 0.25, passed=True),
)


def test_every_stage_has_its_number_and_how_far_it_was_from_the_opposite():
    refused = LoopAttempt(2, 1, 0.9, verification(FEW), FEW, checks=STAGES)
    held = replace(refused, outcome=MOTION, checks=(*STAGES[:2], STAGES[3]))
    first, second = loop_records(result((refused, held)), None)
    assert [each.stage for each in first.stages] == [
        "similarity",
        "matches",
        "inliers",
        "inlier_ratio",
    ]
    assert [each.passed for each in first.stages] == [True, True, False, True]
    assert (first.decided_by, first.margin) == ("inliers", 13.0)
    assert (second.decided_by, second.measured, second.needed) == ("inlier_ratio", 0.3, 0.25)
    assert second.margin == pytest.approx(-0.05)


def test_a_killed_run_is_read_from_its_folder_but_for_what_is_torn(tmp_path):
    left = tmp_path / "unfinished"
    left.mkdir()
    write_ledger(left / "loops.jsonl", result(), None)
    whole = (left / "loops.jsonl").read_text()
    (left / "loops.jsonl").write_text(whole + whole[:30])
    assert read_ledger(tmp_path) == loop_records(result(), None)
    write_ledger(tmp_path / "loops.jsonl", result(ATTEMPTS[:1]), None)
    assert len(read_ledger(tmp_path)) == 1


@pytest.mark.parametrize(
    ("written", "told"),
    [
        ('"version": 3', "is of schema 3, .* update loopclose"),
        ('"older": 1', "was written before .*"),
    ],
)
def test_another_version_of_the_schema_is_told(tmp_path, written, told):
    path = tmp_path / "loops.jsonl"
    write_ledger(path, result(), None)
    path.write_text(path.read_text().replace('"version": 2', written))
    with pytest.raises(SlamError, match=f"^line 1 of the loop ledger {told}: {path}$"):
        read_ledger(path)


def test_a_ledger_of_the_version_before_is_read(tmp_path):
    path = tmp_path / "loops.jsonl"
    write_ledger(path, result(), None)
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    old = [{**line, "version": 1} for line in lines if line.pop("proposed_by")]
    path.write_text("".join(f"{json.dumps(line)}\n" for line in old))
    records = loop_records(result(), None)
    assert read_ledger(path) == tuple(replace(each, version=1) for each in records)


def test_a_line_says_what_made_it_a_candidate(tmp_path):
    again = replace(ATTEMPTS[0], proposed_by=Proposal.OVERLAP)
    write_ledger(tmp_path / "l", result((*ATTEMPTS[:1], again)), None)
    assert [each.proposed_by for each in read_ledger(tmp_path / "l")] == ["similarity", "overlap"]


def test_lines_are_plain_json_in_the_order_of_the_attempts(tmp_path):
    odd = Rejection(RejectionReason.NARROW_SUPPORT, NAN, math.inf)
    attempts = (*ATTEMPTS, LoopAttempt(2, 1, 0.6, None, odd))
    write_ledger(tmp_path / "l", result(attempts), drift((*TRUTHS, TRUTHS[2])))
    text = (tmp_path / "l").read_text()
    assert "NaN" not in text
    assert "Infinity" not in text
    lines = [json.loads(line) for line in text.splitlines()]
    assert [line["query_id"] for line in lines] == [2, 2, 1, 1, 2]
    assert len({tuple(line) for line in lines}) == 1
    assert list(lines[0])[:3] == ["version", "query_id", "match_id"]


@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (lambda line: line[:20], "Invalid JSON"),
        (lambda line: "", "Invalid JSON"),
        (lambda line: line.replace('"match_id": 1', '"match_id": "one"'), "match_id: .*integer"),
        (lambda line: line.replace('"match_id"', '"matched"'), "match_id: .*required"),
        (lambda line: line.replace("{", '{"extra": 1, ', 1), "extra: "),
        (lambda line: line.replace('"margin": 13.0', '"margin": NaN'), "margin: .*finite"),
    ],
)
def test_a_malformed_line_is_named(tmp_path, spoil, complaint):
    path = tmp_path / "loops.jsonl"
    write_ledger(path, result(), None)
    lines = path.read_text().splitlines()
    path.write_text("\n".join([lines[0], spoil(lines[1]), *lines[2:]]))
    with pytest.raises(SlamError, match=f"^line 2 of the loop ledger: .*{complaint}") as caught:
        read_ledger(path)
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith(str(path))


def test_a_ledger_that_cannot_be_read(tmp_path):
    with pytest.raises(SlamError, match="No such file or directory"):
        read_ledger(tmp_path / "absent.jsonl")
    (tmp_path / "l").write_bytes(b"\x80\xff")
    with pytest.raises(SlamError, match="the loop ledger is not text"):
        read_ledger(tmp_path / "l")


def test_keyframes_may_be_numbered_anew(tmp_path):
    path = tmp_path / "loops.jsonl"
    write_ledger(path, result(), drift())
    before = read_ledger(path)
    lines = path.read_text().splitlines()
    assert [renumbered(line, 0) for line in lines] == lines
    path.write_text("".join(f"{renumbered(line, 7)}\n" for line in lines))
    moved = [
        replace(each, query_id=each.query_id + 7, match_id=each.match_id + 7) for each in before
    ]
    assert list(read_ledger(path)) == moved
    for line in ("{", "[]", "{}", '{"query_id": "x", "match_id": 1}'):
        with pytest.raises(SlamError, match="no loop record"):
            renumbered(line, 7)
