# SPDX-License-Identifier: Apache-2.0
import pytest

from benchmarks import stalls as benchmark
from slam.demo.recording import render_sequence
from slam.geometry.features import FeatureExtractor
from slam.types import Camera

pytestmark = pytest.mark.usefixtures("built_rooms")


def tables(text: str) -> list[list[list[str]]]:
    """Return the cells of each table of a page."""
    blocks = [block for block in text.split("\n\n") if block.startswith("|")]
    return [
        [[cell.strip() for cell in line.strip("|").split("|")] for line in block.splitlines()]
        for block in blocks
    ]


def test_all_calls_of_a_run_are_counted_and_the_longest_taken_apart(tmp_path, capsys):
    camera = Camera(160, 120, 131.25, 131.25, 79.5, 59.5)
    render_sequence(tmp_path / "tiny", seconds=1.0, camera=camera)
    before = FeatureExtractor.extract
    page = tmp_path / "page.md"
    options = ["--recognizer", "gradients", "--runs", "2", "--out", str(page)]
    assert benchmark.main([str(tmp_path / "tiny"), *options]) == 0
    assert FeatureExtractor.extract is before
    assert page.read_text() == capsys.readouterr().out
    distribution, longest, _ = tables(page.read_text())
    numbers = {row[0]: row[1] for row in distribution}
    assert numbers["all"] == "15" and numbers["the first"] == "1"
    in_order = [float(cell) for cell in distribution[2][2:6]]
    assert in_order == sorted(in_order)
    for frame, ms, computing, *parts_and_gc in longest[2:]:
        *parts, _ = (float(cell) for cell in parts_and_gc)
        assert 0.0 < sum(parts) <= float(ms) + 0.1 * len(parts), frame
        assert float(computing) > 0.0


def test_the_worst_of_several_runs_is_shown():
    calm = [benchmark.Call(i, ms=10.0, cpu_ms=9.0) for i in range(4)]
    tense = [benchmark.Call(i, ms=10.0 + 100.0 * (i == 2), cpu_ms=9.0) for i in range(4)]
    rows = {row[0]: row[1:] for row in tables(benchmark.distribution([calm, tense]))[0]}
    assert rows["all"][1] == "10.0" and rows["all"][4:] == ["110.0", "1"]
    assert rows["all, computing"][4:] == ["9.0", "0"]
    assert "later keyframes" not in rows
    longest = tables(benchmark.longest([*calm, *tense], "frame"))[0]
    assert longest[2][:3] == ["2", "110.0", "9.0"] and len(longest) == 2 + benchmark.LONGEST


def test_what_is_not_there_is_said(capsys):
    assert benchmark.main(["fr9_nowhere"]) == 1
    assert "fr9_nowhere" in capsys.readouterr().err
