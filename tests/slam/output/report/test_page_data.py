# SPDX-License-Identifier: Apache-2.0
import base64
import json
from dataclasses import replace

import numpy as np
from numpy.testing import assert_allclose

from slam.output.decision import decisions
from slam.output.report import page_data as module
from slam.output.report.page_data import curves, page_data
from slam.output.report.paths import gather


def numbers(packed: str, kind: str = "<f4") -> np.ndarray:
    return np.frombuffer(base64.b64decode(packed), kind)


def data_of(result, drift=None):
    return page_data(result, drift, gather(result, drift), decisions(result, drift), [])


def test_it_is_json_and_the_same_every_time(run) -> None:
    text = json.dumps(data_of(run.result, run.drift), allow_nan=False)
    assert json.dumps(data_of(run.result, run.drift)) == text


def test_curves_are_the_errors_that_were_measured(run) -> None:
    found = data_of(run.result, run.drift)["frames"]["curves"]
    assert [each["name"] for each in found] == ["odometry", "without loops", "with loops"]
    for each, name in zip(found, ("odometry", "without_loops", "corrected"), strict=True):
        error = getattr(run.drift, name)
        rmse = np.sqrt(np.nanmean(numbers(each["lengths"]) ** 2)) / 100
        assert_allclose(rmse, error.ate_rmse_m, rtol=1e-5)


def test_frames_that_truth_does_not_cover_have_no_error(run) -> None:
    errors = run.drift.corrected
    half = replace(
        errors,
        timestamps_s=errors.timestamps_s[::2],
        position_errors_m=errors.position_errors_m[::2],
    )
    corrected = curves(run.result, replace(run.drift, corrected=half))[-1]
    assert np.isnan(corrected.lengths_m[1::2]).all()
    assert_allclose(corrected.lengths_m[::2], half.position_errors_m)


def test_without_truth_the_curve_is_how_far_loops_moved(run) -> None:
    (moved,) = curves(run.result, None)
    assert_allclose(moved.lengths_m, run.result.moved_by_loops_m)
    assert len(moved.per_metre) == 0


def test_matches_are_where_they_were_seen_and_those_that_agree_come_first(run) -> None:
    loops = decisions(run.result, run.drift)
    number = next(i for i, each in enumerate(loops) if each.inliers)
    told = data_of(run.result, run.drift)["loops"][number]
    check = loops[number].attempt.verification
    ends = numbers(told["matches"], "<u2").reshape(-1, 4) / 65535 * (640, 480, 640, 480)
    assert told["agreeing"] == check.inlier_mask.sum()
    assert_allclose(ends[: told["agreeing"]], check.pixels[check.inlier_mask], atol=0.01)
    assert_allclose(ends[told["agreeing"] :], check.pixels[~check.inlier_mask], atol=0.01)


def test_a_loop_whose_matches_were_not_kept_has_none(run) -> None:
    loop = next(each for each in decisions(run.result, None) if each.inliers)
    bare = replace(loop.attempt, verification=loop.attempt.verification.without_evidence)
    listed = [replace(loop, attempt=bare)]
    told = page_data(run.result, None, gather(run.result, None), listed, [])["loops"][0]
    assert (told["matches"], told["agreeing"]) == ("", 0)


def test_of_many_frames_every_nth_is_drawn_and_every_keyframe(run, monkeypatch) -> None:
    monkeypatch.setattr(module, "_MOST_FRAMES", 50)
    told = data_of(run.result, run.drift)
    times_s = numbers(told["frames"]["times_s"])
    assert 50 <= len(times_s) <= 90
    keyframes_s = [each.timestamp_s for each in run.result.keyframes]
    assert_allclose(times_s[told["keyframes"]["frames"]], keyframes_s, rtol=1e-6)
    assert len(numbers(told["frames"]["stages"][2])) == 3 * len(times_s)
    assert len(numbers(told["frames"]["curves"][0]["lengths"])) == len(times_s)


def test_matrices_are_shades_between_their_ends(run, altered) -> None:
    similarities = run.result.similarities.copy()
    similarities[2, 3] = np.nan
    told = data_of(altered(similarities=similarities))["matrices"]["similarity"]
    shades = numbers(told["shades"], "u1").reshape(40, 40).astype(float)
    assert shades[2, 3] == 255
    found = told["low"] + shades / 254 * (told["high"] - told["low"])
    known = np.isfinite(similarities)
    assert_allclose(found[known], similarities[known], atol=0.003)


def test_figures_of_all_loops_know_those_that_are_not_listed(run) -> None:
    loops = decisions(run.result, run.drift)
    whole = data_of(run.result, run.drift)["loops"]
    part = page_data(run.result, run.drift, gather(run.result, run.drift), loops[:2], loops[2:])
    assert len(part["loops"]) == 2
    others = part["others"]
    assert numbers(others["pairs"]).reshape(-1, 2).tolist() == [each["pair"] for each in whole[2:]]
    kinds = [("accepted", "false", "outvoted", "rejected")[each] for each in others["groups"]]
    assert kinds == [each["group"] for each in whole[2:]]
    found = numbers(others["similarities"])
    assert_allclose(found, [each["similarity"] for each in whole[2:]], rtol=1e-6)


def test_a_break_stays_one_where_only_every_nth_frame_is_drawn(run, monkeypatch) -> None:
    monkeypatch.setattr(module, "_MOST_FRAMES", 50)
    paths = gather(run.result, run.drift)
    times_s = paths.times_s.copy()
    times_s[103:] += 0.5  # less than from one drawn frame to the next four times
    paths = replace(paths, times_s=times_s)
    loops = decisions(run.result, run.drift)
    frames = page_data(run.result, run.drift, paths, loops, [])["frames"]
    (first,) = frames["breaks"]
    drawn_s = numbers(frames["times_s"])
    assert drawn_s[first - 1] < times_s[103] - 0.5 < times_s[103] <= drawn_s[first] + 1e-4
