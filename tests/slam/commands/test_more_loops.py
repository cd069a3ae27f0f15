# SPDX-License-Identifier: Apache-2.0
"""Loops that a run missed are found once its map is solved, and false ones are not taken."""

import json
from dataclasses import replace

import numpy as np
import pytest

from slam import read_ledger
from slam.__main__ import main
from slam.geometry import se3
from slam.loops import loop_closure
from slam.loops.loop_closure import LoopCloser
from slam.output.comparison.runs import read_runs
from slam.output.replay.replayed import ReplayedSlam
from slam.types import Rejection, RejectionReason, RelativePose

NOTHING_IS_ALIKE = ("--loop.min-similarity", "1.0")
DECIDED = ("trajectory.txt", "keyframes.txt", "loops.jsonl", "pose_graph.g2o")
AGAIN = ("overlap", "next_similar")


@pytest.fixture(scope="module")
def blind(run, recording, tmp_path_factory):
    """Return the folder of a run that took no two images for one place."""
    return run(recording, tmp_path_factory.mktemp("blind") / "run", *NOTHING_IS_ALIKE)


@pytest.fixture(scope="module")
def again(blind):
    """Return the folder in which its loops were looked for again."""
    assert main(["more-loops", str(blind)]) == 0
    return blind.with_name("run-more-loops")


def more_loops(folder, out, *settings):
    assert main(["more-loops", str(folder), "--out", str(out), *settings]) == 0
    return told(out)


def told(folder):
    return json.loads((folder / "summary.json").read_text())


def new_loops(folder):
    return [each for each in read_ledger(folder) if each.proposed_by in AGAIN]


def test_what_a_run_missed_is_found_and_true(blind, again):
    assert not any(each.accepted for each in read_ledger(blind))
    found = [each for each in new_loops(again) if each.accepted]
    assert found and not any(each.truth.is_false for each in found)
    assert {each.proposed_by for each in found} == {"overlap"}
    assert all(each.similarity < each.min_similarity for each in found)
    assert len(new_loops(again)) > len(found)  # geometry's no is one here, too
    assert (again / "report.html").stat().st_size > 10_000


def test_the_summary_says_what_was_tried_and_found(blind, again):
    new, more = new_loops(again), told(again)["more_loops"]
    assert told(blind)["more_loops"] is None
    for name in AGAIN:
        of_it = [each for each in new if each.proposed_by == name]
        assert more[f"pairs_{name}"] == len(of_it)
        assert more[f"found_{name}"] == sum(each.accepted for each in of_it)
    assert (more["loops_before"], more["dropped"], more["found_false"]) == (0, 0, 0)
    assert more["ate_before_m"] == told(blind)["ate_corrected_m"] != told(again)["ate_corrected_m"]
    assert more["moved_mm"] > 0.01


def test_no_pair_is_looked_at_twice_and_what_the_run_tried_comes_first(blind, again):
    first, loops = read_ledger(blind), read_ledger(again)
    assert loops[: len(first)] == first
    asked = [(each.query_id, each.match_id) for each in loops if each.matches is not None]
    assert len(asked) == len(set(asked)) and all(match < query for query, match in asked)


def test_the_same_run_gives_the_same_bytes(blind, again, tmp_path):
    more_loops(blind, tmp_path)
    for name in DECIDED:
        assert (again / name).read_bytes() == (tmp_path / name).read_bytes(), name


def test_thresholds_of_geometry_are_those_of_the_run(blind, tmp_path):
    more = more_loops(blind, tmp_path, "--verification.min-inliers", "900")["more_loops"]
    new = new_loops(tmp_path)
    assert more["rounds"] == 1 and new and not any(each.accepted for each in new)
    assert "few_inliers" in {each.reason for each in new}


def test_false_loops_that_fool_geometry_are_outvoted(blind, tmp_path, monkeypatch):
    verify = LoopCloser.verify

    def fooled(self, query, match, *others):
        seen = verify(self, query, match, *others)
        if not isinstance(seen.outcome, RelativePose):
            return seen
        off = se3.exp(np.array([0.0, 0.3, 0.0, 0.5 + query.id, 0.0, 0.3 * match.id]))
        T = seen.outcome.T_ref_query @ off
        return replace(seen, outcome=replace(seen.outcome, T_ref_query=T))

    monkeypatch.setattr(LoopCloser, "verify", fooled)
    more_loops(blind, tmp_path)
    verified = [each for each in new_loops(tmp_path) if each.weight is not None]
    assert verified and {each.reason for each in verified} == {"outvoted"}
    assert (tmp_path / "trajectory.txt").read_bytes() == (blind / "trajectory.txt").read_bytes()


def test_poses_from_elsewhere_are_corrected_by_what_is_found(run, blind, recording, tmp_path):
    given = ("--odometry", str(blind / "odometry.txt"))
    folder = run(recording, tmp_path / "run", *NOTHING_IS_ALIKE, *given)
    assert more_loops(folder, tmp_path / "again")["more_loops"]["rounds"] > 0
    assert any(each.accepted for each in new_loops(tmp_path / "again"))
    for name in ("corrected_odometry.txt", "map_odom.txt"):
        assert (tmp_path / "again" / name).read_bytes() != (folder / name).read_bytes()


def test_in_a_map_of_one_keyframe_there_is_nothing_to_look_for(run, short_recording, tmp_path):
    folder = run(short_recording(2), tmp_path / "run")
    assert more_loops(folder, tmp_path / "again")["more_loops"]["rounds"] == 0


def test_it_is_compared_with_its_run(blind, again):
    (group,) = read_runs([blind, again])
    assert group.differing["more-loops"] == ("not told", str(blind))


def test_loops_of_the_run_that_are_dropped_are_told(run, recording, tmp_path, monkeypatch):
    alike = run(recording, tmp_path / "run", "--loop.candidates", "1")
    finish, finished = ReplayedSlam.finish, []

    def dropping(self):
        finished.append(finish(self))
        result = finished[-1]
        if len(finished) < 2:
            return result
        lost = next(n for n, each in enumerate(result.attempts) if each.rejection is None)
        outvoted = Rejection(RejectionReason.OUTVOTED, 0.0, 0.5)
        attempts = list(result.attempts)
        attempts[lost] = replace(attempts[lost], outcome=outvoted)
        return replace(result, attempts=tuple(attempts))

    monkeypatch.setattr(ReplayedSlam, "finish", dropping)
    summary = more_loops(alike, tmp_path / "again")
    assert summary["more_loops"]["dropped"] == 1 <= summary["more_loops"]["loops_before"]
    assert any("contradict the run: 1 of its" in each for each in summary["warnings"])


def test_a_run_without_features_is_one_line(run, recording, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(loop_closure, "MOST_REMEMBERED", 2)
    folder = run(recording, tmp_path / "run")
    capsys.readouterr()
    assert main(["more-loops", str(folder)]) == 2
    said = capsys.readouterr().err
    assert (
        said.startswith("run_slam more-loops: the run kept no features") and said.count("\n") == 1
    )
    assert not folder.with_name("run-more-loops").exists()
