# SPDX-License-Identifier: Apache-2.0
import re
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from slam.output.decision import decisions
from slam.output.report.flat_drawings import drift_along_time, path_from_above
from slam.output.report.page_data import curves
from slam.output.report.paths import gather


def lines(drawing: str, colour: str) -> np.ndarray:
    """Return the (N, 2) points of the last line of a colour."""
    (*_, line) = [
        each.get("d")
        for each in ElementTree.fromstring(drawing).iter("path")
        if f"--{colour})" in each.get("style", "") and each.get("class") == "line"
    ]
    return np.array(re.findall(r"([\d.]+) ([\d.]+)", line), float)


def test_the_path_is_seen_from_above_a_metre_as_long_on_both_axes(run) -> None:
    paths = gather(run.result, None)
    drawing = path_from_above(paths, decisions(run.result, None))
    drawn = lines(drawing, "after")
    x, z = paths.corrected[:, 0, 3], paths.corrected[:, 2, 3]
    per_m = np.ptp(drawn[:, 0]) / np.ptp(x)
    assert np.ptp(drawn[:, 1]) == pytest.approx(per_m * np.ptp(z), abs=0.2)
    assert np.corrcoef(drawn[:, 0], x)[0, 1] > 0.999
    assert np.corrcoef(drawn[:, 1], z)[0, 1] < -0.999  # away is up on the page
    assert ">x (m)<" in drawing and ">z (m)<" in drawing


def test_errors_are_drawn_at_their_times(run) -> None:
    drawing = drift_along_time(gather(run.result, run.drift), curves(run.result, run.drift))
    for colour in ("before", "without", "after"):
        assert len(lines(drawing, colour)) == 200
    errors = run.drift.odometry.position_errors_m
    assert np.corrcoef(lines(drawing, "before")[:, 1], errors)[0, 1] < -0.999
    assert ">position error (cm)<" in drawing


def test_lines_are_interrupted_where_nothing_is_known(run) -> None:
    paths = gather(run.result, run.drift)
    times_s = paths.times_s.copy()
    times_s[100:] += 9.0
    (_, _, after) = curves(run.result, run.drift)
    lengths_m = after.lengths_m.copy()
    lengths_m[50:60] = np.nan
    drawing = drift_along_time(
        replace(paths, times_s=times_s, lost_s=np.array([12.0])),
        [replace(after, lengths_m=lengths_m)],
    )
    line = re.search(r'class="line" d="([^"]*)"', drawing)[1]
    assert line.count("M") == 3 and line.count("L") == 190 - 3
    assert "--lost)" in drawing


@pytest.mark.parametrize("keyframes", [1, 2])
def test_a_run_that_hardly_moved_has_drawings(make, keyframes: int) -> None:
    run = make(keyframes, attempts=0)
    paths = gather(run.result, None)
    for drawing in (path_from_above(paths, []), drift_along_time(paths, curves(run.result, None))):
        assert ElementTree.fromstring(drawing).get("aria-label")
        assert "nan" not in drawing


def test_a_line_is_interrupted_at_its_gap_where_every_nth_point_is_drawn(run, monkeypatch) -> None:
    monkeypatch.setattr("slam.output.report.flat_drawings._MOST_POINTS", 40)  # every fifth
    paths = gather(run.result, run.drift)
    times_s = paths.times_s.copy()
    times_s[102:] += 9.0
    (*_, after) = curves(run.result, run.drift)
    drawing = drift_along_time(replace(paths, times_s=times_s), [after])
    line = re.search(r'class="line" d="([^"]*)"', drawing)[1]
    starts, ends = (re.findall(rf"{letter}([\d.]+)", line) for letter in "ML")
    assert len(starts) == 2
    first_after = float(starts[1])
    before = [float(u) for u in ends if float(u) < first_after]
    assert first_after - max(before) > 50.0  # nothing is drawn across it
