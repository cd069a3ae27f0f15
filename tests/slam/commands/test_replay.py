# SPDX-License-Identifier: Apache-2.0
"""What is decided again without images is what a run decides with them."""

import json
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest

from slam import read_ledger
from slam.__main__ import main
from slam.commands.replay import parse
from slam.config import Config
from slam.loops import loop_closure
from slam.output.run_folder import settings_file

DECIDED = ("trajectory.txt", "odometry.txt", "keyframes.txt", "loops.jsonl", "pose_graph.g2o")


@pytest.fixture(scope="module")
def whole(run, recording, tmp_path_factory):
    return run(recording, tmp_path_factory.mktemp("whole") / "run")


@pytest.fixture(scope="module")
def without_features(run, recording, tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(loop_closure, "MOST_REMEMBERED", 2)
        return run(recording, tmp_path_factory.mktemp("large") / "run")


def replay(folder, *settings):
    assert main(["replay", str(folder), *settings]) == 0
    return folder.with_name("run-replay")


def killed(run, recording, folder):
    """Return the folder of a run that was killed before its outputs were made."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("slam.output.ending.conclude", failing(KeyboardInterrupt))
        return run(recording, folder, code=2)


def failing(error):
    def fail(*_):
        raise error

    return fail


def warnings(folder):
    return json.loads((folder / "summary.json").read_text())["warnings"]


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


def test_other_thresholds_decide_what_a_run_with_them_does(run, whole, recording, tmp_path):
    strict = ("--verification.min-inliers", "300", "--loop.candidates", "6")
    fresh, again = run(recording, tmp_path / "run", *strict), replay(whole, *strict)
    assert (again / "loops.jsonl").read_bytes() != (whole / "loops.jsonl").read_bytes()
    for name in DECIDED:
        assert (again / name).read_bytes() == (fresh / name).read_bytes(), name


def test_poses_from_elsewhere_are_judged_again(run, whole, recording, tmp_path):
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


@pytest.mark.parametrize("is_first", [True, False])
def test_the_settings_of_the_run_hold_wherever_it_is_named(tmp_path, is_first):
    config = Config()
    loop = config.loop.model_copy(update={"candidates": 7})
    text = settings_file("run_slam room", config.model_copy(update={"loop": loop}))
    (tmp_path / "settings.toml").write_text(text)
    flags = ["--verification.min-inliers", "21"]
    told = parse([str(tmp_path), *flags] if is_first else [*flags, str(tmp_path)])
    assert told.run == tmp_path and told.settings.verification.min_inliers == 21
    assert told.settings.loop.candidates == 7


def test_what_reading_found_is_told_again(run, short_recording, tmp_path):
    folder = short_recording(8)
    sorted((folder / "rgb").iterdir())[3].write_bytes(b"")
    ran = run(folder, tmp_path / "run")
    (skipped,) = [each for each in warnings(ran) if "skipped" in each]
    again = warnings(replay(ran))
    assert skipped in again and not any("stopped early" in each for each in again)


def test_a_killed_run_that_was_finished_is_not_whole(run, short_recording, tmp_path):
    folder = killed(run, short_recording(8), tmp_path / "run")
    assert main([str(folder), "--finish"]) == 0
    again = replay(folder)
    assert any("the run stopped early" in each for each in warnings(again))
    summary = json.loads((again / "summary.json").read_text())
    assert summary["elapsed_s"] is None and summary["frames_per_second"] is None
    assert summary["compiling_s"] is None


@pytest.mark.parametrize(("inside", "named"), [("run", "."), ("run/deeper", "..")])
def test_the_folder_it_stands_in_is_named_by_its_name(
    run, short_recording, tmp_path, monkeypatch, inside, named
):
    run(short_recording(8), tmp_path / "run")
    (tmp_path / inside).mkdir(exist_ok=True)
    monkeypatch.chdir(tmp_path / inside)
    assert main(["replay", named]) == 0
    assert (tmp_path / "run-replay" / "trajectory.txt").exists()


@pytest.mark.parametrize(
    ("error", "told"),
    [(ValueError("bad numbers"), "makes no sense: ValueError"), (KeyboardInterrupt(), "interr")],
)
def test_of_a_replay_that_fails_nothing_is_left(whole, tmp_path, monkeypatch, capsys, error, told):
    monkeypatch.setattr("slam.output.replay.replayed.ReplayedSlam.finish", failing(error))
    (tmp_path / "out").mkdir()
    assert told in refusal(capsys, whole, "--out", tmp_path / "out")
    assert not list((tmp_path / "out").iterdir())


def test_a_killed_run_that_is_replaced_is_told(run, short_recording, tmp_path, capsys):
    recording = short_recording(8)
    ran, unfinished = run(recording, tmp_path / "run"), killed(run, recording, tmp_path / "killed")
    capsys.readouterr()
    replay(ran, "--out", str(unfinished))
    assert "was killed, and this one replaces it" in capsys.readouterr().err


def test_a_recording_called_replay_is_reached_by_its_path(run, recording, tmp_path, monkeypatch):
    shutil.copytree(recording, tmp_path / "replay")
    monkeypatch.chdir(tmp_path)
    assert (run("./replay", tmp_path / "out") / "trajectory.txt").exists()


def test_help_names_and_teaches_it(capsys):
    for typed, told in (
        (["--help"], "|replay|"),
        (["replay", "--help"], "the same decisions again"),
    ):
        with pytest.raises(SystemExit) as ended:
            main(typed)
        assert ended.value.code in (0, None) and told in capsys.readouterr().out


def test_of_a_run_of_hours_nothing_is_kept_and_that_is_said(run, recording, tmp_path, monkeypatch):
    monkeypatch.setattr("slam.output.ending._MOST_MEASURED", 2)
    folder = run(recording, tmp_path / "run")
    assert not (folder / "measurements.npz").exists()
    (warning,) = [each for each in warnings(folder) if "run_slam replay" in each]
    assert "more than 2, too much was measured" in warning
