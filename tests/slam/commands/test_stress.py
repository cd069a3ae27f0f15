# SPDX-License-Identifier: Apache-2.0
import json
import shutil
import sys
from dataclasses import replace

import numpy as np
import pytest

from placerec.recognizers.gradients import GradientRecognizer
from slam.__main__ import main
from slam.output.stress.stressors import STRESSORS, Stressor
from slam.output.stress.trials import Bench

ASKED = ("--recognizer", "gradients", "--only", "dropped-frames,false-clusters,odometry-noise")
KINDS = ("csv", "json", "png", "svg")


LEVELS = {"dropped-frames": (0.2, 0.8), "false-clusters": (0.3, 0.8), "odometry-noise": (1.0, 8.0)}


@pytest.fixture(autouse=True, scope="module")
def few_levels():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "path", list(sys.path))
        for name, levels in LEVELS.items():
            patch.setitem(STRESSORS, name, replace(STRESSORS[name], levels=levels))
        yield


@pytest.fixture(scope="module")
def stressed(few_levels, recording, tmp_path_factory):
    """Return the folder of a stress that was stopped on the way and gone on with."""
    folder = tmp_path_factory.mktemp("stress") / "out"
    tried = Bench.tried

    def stopped(bench, stressor, level, progress):
        if stressor == "false-clusters" and level == 0.8:
            raise KeyboardInterrupt
        return tried(bench, stressor, level, progress)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Bench, "tried", stopped)
        assert main(["stress", str(recording), *ASKED, "--out", str(folder)]) == 2
        left = {each: each.stat().st_mtime_ns for each in (folder / "trials").iterdir()}
        patch.setattr(Bench, "tried", tried)
        assert main(["stress", str(recording), *ASKED, "--out", str(folder)]) == 0
    assert len(left) == 3 and all(each.stat().st_mtime_ns == then for each, then in left.items())
    return folder


def trials(folder, stressor):
    return json.loads((folder / "tolerance.json").read_text())["stressors"][stressor]["trials"]


def test_what_was_asked_for_is_tried_and_drawn(stressed):
    told = json.loads((stressed / "tolerance.json").read_text())
    assert set(told["stressors"]) == {"dropped-frames", "false-clusters", "odometry-noise"}
    clean = told["clean"]
    assert clean["has_truth"] and clean["ate_m"] < 0.02 and clean["loops_kept"] > 0
    assert all((stressed / f"tolerance.{kind}").stat().st_size > 500 for kind in KINDS)
    frames = [each["frames"] for each in trials(stressed, "dropped-frames")]
    assert 60 > frames[0] > frames[-1] > 0


def test_injected_loops_are_refused_or_the_run_says_that_something_is_wrong(stressed):
    clean = json.loads((stressed / "tolerance.json").read_text())["clean"]
    tried = trials(stressed, "false-clusters")
    assert 0 < tried[0]["false_injected"] < tried[1]["false_injected"]
    for each in tried:
        assert each["false_kept"] == 0 or each["warnings"]
        assert each["ate_m"] < 1.1 * clean["ate_m"] or each["warnings"]


def test_noise_makes_the_odometry_worse_and_not_the_clean_run(stressed):
    errors_m = [each["ate_odometry_m"] for each in trials(stressed, "odometry-noise")]
    assert errors_m == sorted(errors_m)


def test_stopped_or_not_it_gives_the_same_bytes(stressed, recording, tmp_path):
    asked = (*ASKED[:3], "false-clusters")
    assert main(["stress", str(recording), *asked, "--out", str(tmp_path / "again")]) == 0
    assert trials(tmp_path / "again", "false-clusters") == trials(stressed, "false-clusters")


@pytest.mark.parametrize(
    ("asked", "told"),
    [
        (("--only", "blur,fog"), "--only 'fog': there is dropped-frames, "),
        (("--seed", "-1"), "--seed -1"),
        (("--seed", "1", "--out", "OUT"), "a stress with another seed"),
        (("--out", "RECORDING"), "replace files of the recording"),
    ],
)
def test_what_cannot_be_is_one_line(stressed, recording, capsys, asked, told):
    named = {"OUT": str(stressed), "RECORDING": str(recording)}
    typed = [str(recording), *ASKED[:2], *(named.get(each, each) for each in asked)]
    assert main(["stress", *typed]) == 2
    said = capsys.readouterr().err.splitlines()
    assert told in said[-1] and said[-1].startswith("run_slam stress: ")


def test_a_sequence_that_is_not_there_leaves_no_folder_behind(tmp_path, capsys):
    assert main(["stress", str(tmp_path / "none"), "--out", str(tmp_path / "out")]) == 2
    assert "none" in capsys.readouterr().err and not (tmp_path / "out").exists()


def test_without_ground_truth_it_says_what_it_compares_with(short_recording, tmp_path, capsys):
    recording, out = short_recording(30), tmp_path / "out"
    (recording / "groundtruth.txt").unlink()
    asked = ("--recognizer", "gradients", "--only", "odometry-noise", "--out", str(out))
    assert main(["stress", str(recording), *asked]) == 0
    assert "there is no ground truth: how far from the clean run" in capsys.readouterr().out
    told = json.loads((out / "tolerance.json").read_text())
    assert not told["clean"]["has_truth"] and told["clean"]["ate_m"] < 1e-9
    assert trials(out, "odometry-noise")[1]["ate_odometry_m"] > 1e-3


def test_somebodys_files_are_not_written_over(recording, tmp_path, capsys):
    (tmp_path / "tolerance.csv").write_text("mine")
    assert main(["stress", str(recording), *ASKED, "--out", str(tmp_path)]) == 2
    assert "holds a tolerance.csv" in capsys.readouterr().err


def test_trials_that_were_removed_are_made_anew(short_recording, tmp_path):
    typed = ["stress", str(short_recording(30)), *ASKED[:3], "odometry-noise"]
    typed += ["--out", str(tmp_path / "out")]
    assert main(typed) == 0
    before = (tmp_path / "out" / "tolerance.csv").read_bytes()
    shutil.rmtree(tmp_path / "out" / "trials")
    assert main(typed) == 0
    assert (tmp_path / "out" / "tolerance.csv").read_bytes() == before


class Dazzled(GradientRecognizer):
    """Finds nothing to describe in the dark, as whatever divides by a norm."""

    def embed(self, image):
        return super().embed(image) * (1.0 if image.mean() > 50.0 else np.nan)


def test_a_recognizer_that_fails_under_stress_ends_its_trial_alone(
    short_recording, tmp_path, monkeypatch
):
    monkeypatch.setitem(STRESSORS, "darkness", Stressor((0.6,), "share"))
    out, recognizer = tmp_path / "out", f"{__name__}:Dazzled"
    asked = ("--recognizer", recognizer, "--only", "darkness", "--out", str(out))
    assert main(["stress", str(short_recording(30)), *asked]) == 0
    (trial,) = trials(out, "darkness")
    assert "NaN" in trial["ended"] and trial["ate_m"] is None


def test_without_a_loop_to_copy_false_ones_are_not_said_to_be_tolerated(
    short_recording, tmp_path, capsys
):
    typed = ["stress", str(short_recording(30)), *ASKED[:2], "--out", str(tmp_path / "out")]
    assert main([*typed, "--only", "false-loops"]) == 2
    said = capsys.readouterr().err
    assert "false-loops is not tried: the clean run verified no loop" in said
    assert main([*typed, "--only", "false-loops,odometry-noise"]) == 0
    told = json.loads((tmp_path / "out" / "tolerance.json").read_text())
    assert list(told["stressors"]) == ["odometry-noise"]


def test_trials_of_another_recording_or_version_are_not_mixed_in(
    short_recording, tmp_path, capsys, monkeypatch
):
    recording = short_recording(30)
    typed = ["stress", str(recording), *ASKED[:2], "--only", "odometry-noise"]
    typed += ["--out", str(tmp_path / "out")]
    assert main(typed) == 0
    monkeypatch.setattr("slam.commands.stress.__version__", "0.0.0")
    assert main(typed) == 2
    assert "a stress with another loopclose; choose" in capsys.readouterr().err
    monkeypatch.undo()
    for each in ("rgb.txt", "depth.txt"):
        lines = (recording / each).read_text().splitlines(keepends=True)
        (recording / each).write_text("".join(lines[:-5]))
    assert main(typed) == 2
    assert "a stress with another length; choose" in capsys.readouterr().err
