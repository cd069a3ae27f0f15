# SPDX-License-Identifier: Apache-2.0
"""What is decided again without images is what a run decides with them."""

import json
import re
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest

from slam import read_ledger
from slam.__main__ import main
from slam.loops import loop_closure

DECIDED = ("trajectory.txt", "odometry.txt", "keyframes.txt", "loops.jsonl", "pose_graph.g2o")
QUICK = ("--map.write", "False", "--recognizer", "gradients")


def run(recording, folder, *settings):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", list(sys.path))
        patch.setattr("slam.output.run_folder._write_report", lambda path, *_: path.touch())
        assert main([str(recording), *QUICK, "--out", str(folder), *settings]) == 0
    return folder


@pytest.fixture(scope="module")
def whole(recording, tmp_path_factory):
    return run(recording, tmp_path_factory.mktemp("whole") / "run")


@pytest.fixture(scope="module")
def without_features(recording, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop_closure, "MOST_REMEMBERED", 2)
        return run(recording, tmp_path_factory.mktemp("large") / "run")


def replay(folder, *settings):
    assert main(["replay", str(folder), *settings]) == 0
    return folder.with_name("run-replay")


def refusal(capsys, *typed):
    assert main(["replay", *map(str, typed)]) == 2
    said = capsys.readouterr().err
    assert said.startswith("run_slam replay: ") and said.count("\n") == 1
    return said


def test_with_nothing_changed_every_byte_is_the_same(whole):
    again = replay(whole)
    accepted = [each for each in read_ledger(whole) if each.accepted]
    assert accepted and all(each.influence and each.margin is not None for each in accepted)
    assert {each.stages[-1].stage for each in accepted} == {"graph"}
    for name in DECIDED:
        assert (again / name).read_bytes() == (whole / name).read_bytes(), name
    assert (again / "report.html").exists()


def test_other_thresholds_decide_what_a_run_with_them_does(whole, recording, tmp_path):
    strict = ("--verification.min-inliers", "300", "--loop.candidates", "6")
    fresh, again = run(recording, tmp_path / "run", *strict), replay(whole, *strict)
    assert (again / "loops.jsonl").read_bytes() != (whole / "loops.jsonl").read_bytes()
    for name in DECIDED:
        assert (again / name).read_bytes() == (fresh / name).read_bytes(), name


def test_poses_from_elsewhere_are_judged_again(whole, recording, tmp_path):
    given = ("--odometry", str(whole / "odometry.txt"))
    fresh = run(recording, tmp_path / "run", *given)
    again = replay(fresh)
    for name in (*DECIDED, "corrected_odometry.txt", "map_odom.txt"):
        assert (again / name).read_bytes() == (fresh / name).read_bytes(), name


def test_without_features_loops_stay_as_found_and_the_graph_is_weighed_again(
    without_features, capsys
):
    again = replay(without_features)
    before, after = (
        [replace(each, influence=None) for each in read_ledger(folder)]  # which the map judges
        for folder in (without_features, again)
    )
    assert before == after and any(each.accepted for each in after)
    assert "the map is" in (again / "summary.json").read_text()
    said = refusal(capsys, without_features, "--verification.min-inliers", "20")
    assert "--verification.min-inliers cannot be decided again" in said


@pytest.mark.parametrize(
    ("settings", "told"),
    [
        (("--features.count", "500"), "--features.count cannot be decided again"),
        (("--verification.min-inlier", "5"), "min-inlier"),
        (("--out", "RUN"), "the run that is decided again"),
    ],
)
def test_what_cannot_be_decided_again_is_one_line(whole, capsys, settings, told):
    settings = [str(whole) if each == "RUN" else each for each in settings]
    assert told in refusal(capsys, whole, *settings)


@pytest.mark.parametrize(
    ("spoil", "told"),
    [
        (lambda path: path.unlink(), "there is no measurements.npz"),
        (lambda path: path.write_bytes(path.read_bytes()[:-2000]), "cut off"),
        (lambda path: path.write_bytes(b"PK"), "does not hold what a run measured"),
        (lambda path: change(path, about_json=b'{"version": 2}'), "version 2, .*update loopclose"),
        (lambda path: change(path, link_count=b"\1"), "is damaged"),
    ],
)
def test_measurements_that_cannot_be_used_are_one_line(whole, tmp_path, capsys, spoil, told):
    spoilt = tmp_path / "run"
    shutil.copytree(whole, spoilt)
    spoil(spoilt / "measurements.npz")
    assert re.search(told, refusal(capsys, spoilt))


def change(path, **arrays):
    with np.load(path) as found:
        content = dict(found)
    changed = {name: np.frombuffer(each, np.uint8) for name, each in arrays.items()}
    np.savez(path, **content | changed)


def test_a_recording_called_replay_is_reached_by_its_path(recording, tmp_path, monkeypatch):
    shutil.copytree(recording, tmp_path / "replay")
    monkeypatch.chdir(tmp_path)
    assert (run("./replay", tmp_path / "out") / "trajectory.txt").exists()


def test_help_names_and_teaches_it(capsys):
    for typed, told in (
        (["--help"], "run_slam replay"),
        (["replay", "--help"], "the same decisions again"),
    ):
        with pytest.raises(SystemExit) as ended:
            main(typed)
        assert ended.value.code in (0, None) and told in capsys.readouterr().out


def test_of_a_run_of_hours_nothing_is_kept_and_that_is_said(recording, tmp_path, monkeypatch):
    monkeypatch.setattr("slam.output.ending._MOST_MEASURED", 2)
    folder = run(recording, tmp_path / "run")
    assert not (folder / "measurements.npz").exists()
    (warning,) = [
        each
        for each in json.loads((folder / "summary.json").read_text())["warnings"]
        if "run_slam replay" in each
    ]
    assert "more than 2, too much was measured" in warning
