# SPDX-License-Identifier: Apache-2.0
import importlib.util
import sys
from pathlib import Path

import pytest

from slam.demo.recording import render_sequence
from slam.types import Camera

pytestmark = pytest.mark.usefixtures("built_rooms")

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "sequences.py"


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("benchmark_of_sequences", BENCHMARK)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def run(benchmark):
    def make(seconds: float, outputs: tuple[bytes, ...] = (b"poses", b"loops")):
        keys = "frames_tracked frames_untracked keyframes_with_loop"
        keys += " loops_tried loops_verified loops_accepted loops_outvoted"
        errors = "ate rpe_translation rpe_rotation"
        units = {"ate": "m", "rpe_translation": "m", "rpe_rotation": "deg"}
        summary = dict.fromkeys(keys.split(), 10) | {
            f"{error}_{when}_{units[error]}": 0.123456
            for error in errors.split()
            for when in ("odometry", "live", "without_loops", "corrected")
        }
        summary |= {"ate_live_m": 0.2, "ate_without_loops_m": 0.3, "ate_corrected_m": None}
        summary |= {"nees_links_median": 5.0123456, "nees_loops_median": 5.4}
        summary |= {"loops_false": None, "loops_judged": None, "rpe_interval_s": 1.0}
        summary |= {"elapsed_s": 2.0}
        summary |= {"stage_seconds": {"track": 2.0}, "stage_ms_per_frame": {"track": 100.0}}
        return benchmark.Run(seconds, 2 * seconds, 300.0, summary, outputs)

    return make


def rows(text: str) -> dict[str, list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {first: rest for first, *rest in cells}


def test_a_folder_is_run_and_what_is_missing_or_fails_is_left_out(benchmark, tmp_path, capsys):
    camera = Camera(160, 120, 131.25, 131.25, 79.5, 59.5)
    render_sequence(tmp_path / "tiny", seconds=0.5, camera=camera)
    (tmp_path / "empty").mkdir()
    folders = [str(tmp_path / "tiny"), str(tmp_path / "empty"), "fr9_nowhere"]
    assert benchmark.main([*folders, "--runs", "2", "--out", str(tmp_path / "table.md")]) == 0
    out, err = capsys.readouterr()
    assert (tmp_path / "table.md").read_text() == out
    found = rows(out)
    assert found[""] == ["tiny"]
    assert found["frames tracked"] == ["8 of 8"]
    assert found["runs with the same trajectory.txt and loops.jsonl"] == ["2 of 2"]
    assert float(found["peak memory, MB"][0].split()[0]) > 50.0
    assert "rgb.txt" in err.splitlines()[0]
    assert err.splitlines()[1] == "left out, not on this machine: fr9_nowhere"


def test_names_joined_by_a_plus_are_run_as_one_map(benchmark, tmp_path, monkeypatch, run):
    asked = []

    def measure(name, sequences, recognizer, runs):
        asked.append((name, sequences))
        return benchmark.Measured(name, [run(4.0)])

    monkeypatch.setattr(benchmark, "measure", measure)
    for name in ("one", "two", "a+b"):
        (tmp_path / name).mkdir()
    one, two, odd = (str(tmp_path / name) for name in ("one", "two", "a+b"))
    assert benchmark.main([f"{one}+{two}", odd, f"{one}+fr9_nowhere"]) == 0
    assert asked == [("one+two", [one, two]), ("a+b", [odd])]


def test_nothing_to_measure_is_an_error(benchmark, capsys):
    assert benchmark.main(["fr9_nowhere"]) == 1
    assert capsys.readouterr().out == ""


def test_speed_is_of_the_whole_process_and_costs_are_medians(benchmark, run):
    runs = [run(4.0), run(10.0), run(5.0)]
    found = rows(benchmark.table([benchmark.Measured("made-up", runs)]))
    assert found["frames/s, whole process"] == ["4.0 (2.0-5.0)"]
    assert found["CPU seconds, whole process"] == ["10.0 (8.0-20.0)"]
    assert found["seconds for start-up, report, map"] == ["3.0 (2.0-8.0)"]
    assert found["ms per frame: track"] == ["100.0 (100.0-100.0)"]


def test_errors_come_without_loops_and_with_them_and_live(benchmark, run):
    found = rows(benchmark.table([benchmark.Measured("made-up", [run(4.0)])]))
    assert found["ATE, m: odometry, live"] == ["0.1235"]
    assert found["ATE, m: corrected, live"] == ["0.2"]
    assert found["ATE, m: in the end, without loops"] == ["0.3"]
    assert found["ATE, m: in the end, with loops"] == ["-"]
    assert found["RPE, m: odometry → with loops"] == ["0.1235 → 0.1235"]
    assert found["median NEES (5.35 is right): links, loops"] == ["5.012, 5.4"]


def test_runs_that_differ_are_counted(benchmark, run):
    runs = [run(4.0), run(4.0), run(4.0, outputs=(b"poses", b"other loops"))]
    found = rows(benchmark.table([benchmark.Measured("made-up", runs)]))
    assert found["runs with the same trajectory.txt and loops.jsonl"] == ["2 of 3"]


def test_without_ground_truth_there_are_dashes(benchmark, run):
    found = rows(benchmark.table([benchmark.Measured("made-up", [run(4.0)])]))
    assert found["false loops among the accepted"] == ["- of - judged"]
    assert found["seconds for rendering, apart"] == ["-"]
