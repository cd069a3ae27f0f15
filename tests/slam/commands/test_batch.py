# SPDX-License-Identifier: Apache-2.0
import csv
import re
import shlex
import shutil
import sys
from pathlib import Path

import pytest

from placerec.commands.fleet import Finished, Interrupted
from slam.__main__ import main
from slam.commands.batch import Job, parse, run_alone
from slam.commands.named_recordings import named_recordings

ROOT = Path(__file__).parents[3]
PAGES = (ROOT / "README.md", ROOT / "docs" / "batch.md")
COMMANDS = sorted(
    {
        each
        for page in PAGES
        for each in re.findall(r"[ `](run_slam batch [^`\n]+)", page.read_text())
    }
)
QUICK = ("--recognizer", "gradients", "--map.write", "False")


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr("slam.output.run_folder._write_report", lambda path, *_: path.touch())


@pytest.fixture
def started(monkeypatch):
    """Return the runs that were started: one after the other, in this process, without Ray."""
    started = []

    def run_all(work, jobs, fleet, tell):
        for number, job in reversed(list(enumerate(jobs))):
            started.append(job.folder.rsplit("/")[-1])
            tell(Finished(number, work(job)))

    monkeypatch.setattr("placerec.commands.fleet.run_all", run_all)
    return started


@pytest.mark.parametrize("command", COMMANDS)
def test_what_the_pages_tell_to_type_can_be_typed(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "runs.txt").write_text("mon/kinect\ntuesday = tue/kinect\nfr1_desk\n")
    told = parse(shlex.split(command)[2:])
    assert named_recordings(told.recordings)


def batch(out, *typed):
    return main(["batch", *map(str, typed), "--out", str(out), *QUICK])


def test_all_are_run_as_if_alone_and_what_is_done_is_not_done_again(
    short_recording, started, tmp_path, capsys
):
    good, bad, out = short_recording(8, "good"), tmp_path / "bad", tmp_path / "runs"
    bad.mkdir()
    listed = tmp_path / "list.txt"
    listed.write_text("bad\ngood\nlast = good\n")
    assert batch(out, listed) == 2
    assert started == ["last", "good", "bad"]
    told = capsys.readouterr()
    assert told.err.splitlines()[-2].startswith("error: bad: no recording in a known format")
    assert "run_slam batch: 1 of 3 recordings failed" in told.err.splitlines()[-1]
    assert "3 recordings, 1 of which failed" in told.out

    assert main([str(good), "--out", str(tmp_path / "alone"), *QUICK]) == 0
    names = {each.name for each in (tmp_path / "alone").iterdir()}
    assert names == {each.name for each in (out / "last").iterdir()}
    for name in names - {"summary.json"}:
        assert (out / "last" / name).read_bytes() == (tmp_path / "alone" / name).read_bytes(), name

    shutil.rmtree(bad)
    good.rename(bad)  # mended; and what is done needs no recording any more
    started.clear()
    assert batch(out, listed) == 0
    assert started == ["bad"]
    rows = list(csv.DictReader((out / "batch.csv").open()))
    assert [(row["run"], row["state"]) for row in rows] == [
        *(("bad", "done"), ("good", "done"), ("last", "done")),
    ]
    assert "bad/report.html" in (out / "batch.html").read_text()

    capsys.readouterr()
    assert batch(out, listed, "--graph.inlier-probability", "0.9") == 2
    assert "inlier_probability is 0.95 there and 0.9 here; choose" in capsys.readouterr().err
    assert started == ["bad"]


def test_maps_are_kept_where_asked_and_a_run_without_its_map_is_not_done(
    short_recording, started, tmp_path
):
    good, out, maps = short_recording(8, "good"), tmp_path / "runs", tmp_path / "maps"
    assert batch(out, good) == 0
    for again in (["good"], ["good"], ["good"]):
        assert batch(out, good, "--save", maps) == 0
        assert started == ["good", *again] and (maps / "good" / "manifest.json").is_file()


def test_what_died_and_what_is_nowhere_to_be_seen_failed(tmp_path, monkeypatch, capsys):
    def run_all(work, jobs, fleet, tell):
        assert (fleet.address, fleet.cores, fleet.memory_mb) == ("ray://head:10001", 2, 512)
        tell(Finished(1, None, "the worker died"))
        tell(Finished(0, ""))

    monkeypatch.setattr("placerec.commands.fleet.run_all", run_all)
    asked = ("--address", "ray://head:10001", "--cores", "2", "--memory-mb", "512")
    assert batch(tmp_path / "runs", "a", "b", *asked) == 2
    told = " ".join(capsys.readouterr().out.split())
    assert "a: it was run, but its folder does not show that here" in told
    assert "b: the worker died" in told


def test_a_batch_that_is_stopped_says_how_it_goes_on(tmp_path, monkeypatch, capsys):
    def run_all(work, jobs, fleet, tell):
        raise KeyboardInterrupt

    monkeypatch.setattr("placerec.commands.fleet.run_all", run_all)
    assert batch(tmp_path / "runs", "a") == 2
    assert "interrupted; the same command goes on" in capsys.readouterr().err


def test_a_run_that_was_asked_to_end_is_started_again(tmp_path, monkeypatch):
    def interrupted(typed):
        sys.stderr.write("run_slam: interrupted before anything was tracked\n")
        return 2

    monkeypatch.setattr("slam.__main__.main", interrupted)
    with pytest.raises(Interrupted):
        run_alone(Job(str(tmp_path / "a"), ("a",)))


@pytest.mark.parametrize(
    ("typed", "told"),
    [
        (("a", "--cores", "0"), "have to be above 0"),
        (("a", "--recognizer", "nobody"), "nobody"),
        ((), "there is no recording in what was typed"),
        (("x/a", "y/a"), "two runs would be called a"),
        (("x/batch.csv",), "no run can be called batch.csv"),
    ],
)
def test_what_cannot_be_is_one_line_before_anything_starts(tmp_path, capsys, started, typed, told):
    assert main(["batch", *typed, "--out", str(tmp_path / "runs")]) == 2
    assert told in capsys.readouterr().err.splitlines()[-1]
    assert started == [] and not (tmp_path / "runs").exists()


def test_somebodys_files_are_not_written_over(tmp_path, capsys, started):
    (tmp_path / "batch.csv").write_text("mine")
    assert batch(tmp_path, "a") == 2
    assert "holds a batch.csv that is not known" in capsys.readouterr().err and started == []
