# SPDX-License-Identifier: Apache-2.0
import json
from dataclasses import replace

import pytest

from slam.config import Config, GraphConfig, MapConfig
from slam.evaluation.drift import compare_drift
from slam.output.claimed_folder import ClaimedFolder
from slam.output.comparison.batch import (
    Outcome,
    as_files,
    summary_of_done,
    table,
    what_differs,
)
from slam.output.run_folder import write_outputs, write_run

CONFIG = Config(map=MapConfig(write=False))
OTHER = CONFIG.model_copy(update={"graph": GraphConfig(inlier_probability=0.9)})
COMMAND = "run_slam /data/room --recognizer learned"


@pytest.fixture
def folder(run, tmp_path, monkeypatch):
    """The folder of a run, without its page."""
    monkeypatch.setattr("slam.output.run_folder._write_report", lambda path, *_: path.touch())
    drift = compare_drift(run.result, run.truth, CONFIG.evaluation)
    write_run(tmp_path / "room", run.result, drift, run.truth, CONFIG, "room", COMMAND)
    return tmp_path / "room"


def test_a_run_is_done_once_all_of_it_is_there(folder):
    assert summary_of_done(folder)["frames_tracked"] > 0
    (folder / "keyframes.txt").unlink()
    assert summary_of_done(folder) is None
    assert summary_of_done(folder.parent / "none") is None


def test_a_run_that_goes_on_or_was_killed_is_not_done(folder):
    with ClaimedFolder(folder) as claimed:
        claimed.start()
        assert summary_of_done(folder) is None


def test_a_run_that_ended_early_is_not_done(folder, run):
    with ClaimedFolder(folder) as claimed:
        claimed.start()
        told = (CONFIG, "room", COMMAND, None, None, ("interrupted",))
        write_outputs(claimed, run.result, None, None, *told)
    assert json.loads((folder / "summary.json").read_text())["problems"] == ["interrupted"]
    assert summary_of_done(folder) is None


@pytest.mark.parametrize(
    ("recording", "recognizer", "config", "told"),
    [
        ("/data/room", "learned", CONFIG, ""),
        ("/data/../data/room", "learned", CONFIG, ""),
        ("/other/room", "learned", CONFIG, "of the recording /data/room"),
        ("/data/room", "gradients", CONFIG, f"it is of `{COMMAND}`"),
        ("/data/room", "learned", OTHER, "graph.inlier_probability is 0.95 there and 0.9 here"),
    ],
)
def test_what_was_run_otherwise_is_told(folder, recording, recognizer, config, told):
    command = ["run_slam", recording, "--recognizer", recognizer]
    differs = what_differs(folder, summary_of_done(folder), command, config)
    assert differs == told if not told else told in differs


def test_all_are_in_one_table_one_file_and_one_page(folder):
    done = Outcome("room", summary_of_done(folder))
    unknown = replace(done, name="dark", summary={**done.summary, "ate_corrected_m": None})
    outcomes = [done, unknown, Outcome("bad", {}, "there is no depth.txt")]
    shown = table(outcomes)
    assert shown.title == "3 recordings, 1 of which failed"
    assert [row[:2] for row in shown.rows] == [
        ("room", "done"),
        ("dark", "done"),
        ("bad", "failed"),
    ]
    assert len({len(row) for row in (shown.header, *shown.rows)}) == 1
    assert shown.rows[0][7] == f"{done.summary['ate_corrected_m']:.4f}"
    assert shown.rows[1][7] == "-"
    assert ("failed", "bad: there is no depth.txt") in shown.notes
    files = as_files(outcomes)
    assert [line.split(",")[0] for line in files["batch.csv"].splitlines()] == [
        *("run", "room", "dark", "bad"),
    ]
    assert files["batch.html"].count("report.html") == 2
