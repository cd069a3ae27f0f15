# SPDX-License-Identifier: Apache-2.0
import csv
import json
import sys

import numpy as np
import pytest

from slam.__main__ import main
from slam.evaluation.trajectory import write_tum
from slam.geometry import se3
from slam.output.comparison import plots
from slam.types import SlamError, Trajectory

STAMPS_S = 100.0 + 0.1 * np.arange(80)
WAY = np.linspace(0.0, 5.0, 80)[:, None] * np.array([0.3, -0.4, 0.5, 1.0, 0.9, 0.0])
TRUTH = Trajectory(STAMPS_S, se3.exp(WAY))
SUMMARY = {
    "command": "run_slam path/to/room --recognizer learned",
    "warnings": [],
    "loops_tried": 12,
    "loops_accepted": 9,
    "loops_judged": 8,
    "loops_false": 1,
    "frames_tracked": 80,
    "frames_live": 70,
    "ate_odometry_m": 0.02,
    "ate_live_m": 0.0123,
    "ate_corrected_m": 0.01,
    "ate_smoothed_m": None,
    "rpe_translation_live_m": 0.0045,
    "rpe_interval_s": 1.0,
    "association_tolerance_s": 0.02,
    "matched_share": 1.0,
}


@pytest.fixture
def make_run(tmp_path, monkeypatch):
    """Write the folder of a run below runs/, of a seed, and of what is otherwise in it."""
    monkeypatch.chdir(tmp_path)

    def write(name, *, seed=1, truth=TRUTH, settings="[loop]\nthreshold = 1\n", **otherwise):
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        rng = np.random.default_rng(seed)
        for file, size in (("odometry.txt", 0.02), ("trajectory.txt", 0.005)):
            noise = se3.exp(rng.normal(0.0, size, (len(STAMPS_S), 6)))
            write_tum(folder / file, Trajectory(STAMPS_S, TRUTH.T_world_cam @ noise))
        if truth:
            write_tum(folder / "groundtruth.txt", truth)
        (folder / "settings.toml").write_text(settings)
        (folder / "summary.json").write_text(json.dumps(SUMMARY | otherwise))
        return f"runs/{name}"

    return write


@pytest.fixture
def compare(capsys, monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))

    def run(*typed):
        code = main(["compare", *typed])
        printed = capsys.readouterr()
        return code, " ".join(printed.out.split()) if code == 0 else printed.err

    return run


def test_a_row_for_each_estimate_and_what_differs(make_run, compare):
    a = make_run("a", warnings=["too dark"])
    b = make_run("b", seed=2, settings="[loop]\nthreshold = 2\n", loops_accepted=7)
    code, said = compare(a, b)
    assert code == 0 and said.startswith("room: errors (RMSE)")
    for start in ("a odometry 0.0", "a with loops 0.00", "b odometry 0.0", "b with loops 0.00"):
        assert start in said
    assert "a live 0.0123 - - - 0.0045 - ?/70 - -" in said
    assert "80/80 100/100 0.0" in said and "the scale was not adjusted" in said
    assert "loops a: 9 accepted of 12 candidates; 1 of 8 checked are false" in said
    assert "warnings a: 1, in its report.html warnings b: none" in said
    assert "settings loop.threshold: 1 in a, 2 in b" in said


def test_sequences_are_kept_apart(make_run, compare):
    runs = [
        make_run("a"),
        make_run("b", command="run_slam rgbd_dataset_freiburg1_desk --recognizer learned"),
        make_run("c", command="run_slam fr1_desk --recognizer gradients"),
    ]
    code, said = compare(*runs)
    assert code == 0 and said.count("errors (RMSE)") == 2
    assert (
        "fr1_desk: errors" in said and "settings recognizer: learned in b, gradients in c" in said
    )


def test_runs_without_truth_are_told_to_be_compared_with_each_other(make_run, compare):
    nothing = {"truth": None, "ate_corrected_m": None, "loops_judged": None, "loops_false": None}
    code, said = compare(make_run("a", **nothing), make_run("b", seed=2, **nothing))
    assert code == 0 and "room: distances from a, RMS; no errors" in said
    assert "b with loops 0.0" in said
    assert "tell how alike runs are, not which one is right" in said
    assert "9 accepted of 12 candidates; none of them checked by truth" in said


def test_one_run_without_truth_has_no_figures(make_run, compare):
    code, said = compare(make_run("a", truth=None))
    assert code == 0 and "a has no ground truth, and no other run is of its sequence" in said


def test_truth_that_tells_no_rotations_judges_positions_alone(make_run, compare, tmp_path):
    code, said = compare(make_run("a", loops_false=None), "--out", "out")
    assert code == 0 and "unknown unknown unknown unknown unknown 80/80" in said
    assert "its truth does not tell how the camera turned" in said
    rows = list(csv.DictReader((tmp_path / "out" / "table.csv").open()))
    with_numbers = {row["metric"] for row in rows if row["rmse"] and row["matched"]}
    assert with_numbers == {"APE"}


def test_files_for_a_paper(make_run, compare, tmp_path):
    nothing = {"truth": None, "ate_corrected_m": None}
    typed = make_run("a"), make_run("b", seed=2, **nothing), "--out", "out", "--rpe", "1m,2s"
    assert compare(*typed)[0] == 0
    out = tmp_path / "out"
    drawings = ("trajectories", "error_over_time", "rpe_over_length")
    names = {f"1-room-{name}" for name in drawings}
    names |= {f"1-room-distances-{name}" for name in drawings}
    expected = {f"{name}.{kind}" for name in names for kind in ("svg", "png")}
    assert {path.name for path in out.iterdir()} == {
        *expected,
        *("table.csv", "table.tex", "figures.json"),
    }
    (group,) = json.loads((out / "figures.json").read_text())
    assert [(each["run"], each["compared_with"]) for each in group["estimates"]] == [
        *[("a", "truth")] * 3,
        ("b", "a"),
    ]
    assert all("evidence" in each for each in group["estimates"])
    rows = list(csv.DictReader((out / "table.csv").open()))
    assert {(row["alignment"], row["estimate_poses"]) for row in rows} == {
        ("SE(3)", "80"),
        ("SE(3)", "70"),
    }
    assert (out / "table.tex").read_text().count(r"\toprule") == 2
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    assert compare(*typed)[0] == 0
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before


def test_tables_are_kept_where_nothing_can_be_drawn(make_run, compare, monkeypatch, tmp_path):
    def fail(*_, **__):
        raise SlamError("no drawings today")

    monkeypatch.setattr(plots, "plots", fail)
    assert compare(make_run("a"), "--out", "out")[0] == 2
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {"table.csv", "table.tex", "figures.json"}


def test_runs_of_several_recordings_say_where_their_breaks_are_not_known(make_run, compare):
    unknown = "its summary.json does not tell when each starts"
    first = make_run("a", sessions=2, session_starts_s=[104.0])
    code, said = compare(first, make_run("b", sessions=2), make_run("c", sessions=1))
    assert code == 0 and said.count(unknown) == 1 and "b: it is of several" in said


def test_a_run_without_truth_is_smoothed_where_its_settings_say_so(make_run, compare):
    nothing = {"truth": None, "ate_corrected_m": None, "settings": "[motion]\nsmooth = true\n"}
    runs = [make_run("a"), make_run("b", **nothing), make_run("c", given_poses=80, **nothing)]
    code, said = compare(*runs)
    assert code == 0 and "b smoothed 0.0" in said and "c with loops 0.0" in said


def test_truths_that_differ_are_told(make_run, compare):
    moved = Trajectory(STAMPS_S + 0.001, TRUTH.T_world_cam)
    code, said = compare(make_run("a"), make_run("b", truth=moved))
    assert code == 0 and "compared with truths that are not the same" in said


def test_an_estimate_that_cannot_be_compared_does_not_stop_the_others(make_run, compare):
    late = Trajectory(STAMPS_S + 1000.0, TRUTH.T_world_cam)
    code, said = compare(make_run("a"), make_run("b", truth=late))
    assert code == 0 and "a with loops 0.00" in said
    assert "b, with loops: only 0 of 80 poses have one of the truth in time" in said


def without(file):
    return lambda folder: (folder / file).unlink()


def with_content(file, content):
    return lambda folder: (folder / file).write_text(content)


def begun(folder):
    (folder / "summary.json").unlink()
    (folder / "unfinished").mkdir()


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (without("summary.json"), "summary.json is missing; give folders that run_slam wrote"),
        (begun, "runs/a --finish` makes its outputs"),
        (with_content("summary.json", "[1]"), "is none that run_slam wrote"),
        (with_content("summary.json", "{"), "is not valid JSON"),
        (with_content("settings.toml", "= 2"), "is not valid TOML"),
        (with_content("trajectory.txt", "1 2 3"), "no known way to write a pose"),
        (without("odometry.txt"), "No such file"),
    ],
)
def test_a_folder_of_no_run_ends_in_one_line(make_run, compare, tmp_path, change, complaint):
    path = make_run("a")
    change(tmp_path / path)
    code, said = compare(path)
    assert code == 2
    assert said.startswith("run_slam compare: ") and said.count("\n") == 1 and complaint in said


@pytest.mark.parametrize(
    ("typed", "complaint"),
    [
        ([], "needs folders"),
        (["nowhere"], "summary.json is missing"),
        (["x", "y/../x"], "named twice"),
        (["x", "--rpe", "2"], "no distance"),
    ],
)
def test_bad_input_ends_in_one_line(compare, typed, complaint):
    code, said = compare(*typed)
    assert code == 2 and said.count("\n") == 1 and complaint in said


@pytest.mark.parametrize(
    "otherwise",
    [
        {"command": 3},
        {"command": "run_slam 'a"},
        {"command": "run_slam \x1b[2J"},
        {"warnings": 1},
        {"loops_tried": 10**400},
        {"ate_without_loops_m": 0.01, "matched_share": 1e308},
        {"rpe_interval_s": None, "ate_live_m": True},
    ],
)
def test_a_summary_that_tells_less_is_taken_as_it_is(make_run, compare, otherwise):
    code, said = compare(make_run("a", **otherwise))
    assert code == 0 and "a with loops 0.00" in said and said.isprintable()
