# SPDX-License-Identifier: Apache-2.0
import re
import shutil

import numpy as np
import pytest

from placerec.__main__ import main
from placerec.commands import adapt
from placerec.recognizer import load
from placerec.recognizers.learned import DEFAULT_WEIGHTS, LearnedRecognizer
from placerec.training import own_recording
from placerec.training.own_recording import open_own_recording
from placerec.training.run import WEIGHTS_NAME


@pytest.fixture(scope="module")
def adapted(recording, tmp_path_factory):
    """Return the folder of an adaptation to the rendered recording, whose run is in it."""
    out = tmp_path_factory.mktemp("adapted")
    assert main(["adapt", str(recording), "--out", str(out)]) == 0
    return out


def _figures(text):
    """Return the average precision before and after, as they were printed."""
    return [float(row) for row in re.findall(r"\| (?:before|after) \| ([\d.]+) \(", text)]


def test_a_network_is_tuned_by_the_poses_of_run_slam(adapted, recording, capsys, monkeypatch):
    def run_again(*args, **kwargs):
        raise AssertionError("the run was there already")

    monkeypatch.setattr(own_recording.subprocess, "run", run_again)
    first = (adapted / WEIGHTS_NAME).read_bytes()
    assert main(["adapt", str(recording), "--out", str(adapted)]) == 0
    told = capsys.readouterr().out
    before, after = _figures(told)
    is_better = "\nbetter: written to" in told
    assert is_better == (after > before) and is_better == (first != DEFAULT_WEIGHTS.read_bytes())
    assert (adapted / WEIGHTS_NAME).read_bytes() == first  # the same every time
    recognizer = load(str(adapted / WEIGHTS_NAME))
    image = np.random.default_rng(0).integers(0, 256, (60, 80, 3), np.uint8)
    assert np.linalg.norm(recognizer.embed(image)) == pytest.approx(1.0, abs=1e-5)
    assert recognizer.min_similarity == LearnedRecognizer().min_similarity


def test_what_would_be_worse_is_not_taken(adapted, recording, tmp_path, capsys, monkeypatch):
    shutil.copytree(adapted / recording.name, tmp_path / recording.name)
    true_judge, asked = adapt.evaluate, []

    def judge(dataset, embeddings):
        asked.append(embeddings)
        # The second time it is asked about the recording, places are mixed up.
        mixed = embeddings[::-1] if len(asked) == 2 else embeddings
        return true_judge(dataset, np.ascontiguousarray(mixed))

    monkeypatch.setattr(adapt, "evaluate", judge)
    assert main(["adapt", str(recording), "--out", str(tmp_path)]) == 0
    told = capsys.readouterr().out
    before, after = _figures(told)
    assert after < before and "\nno better: the weights as they were" in told
    assert (tmp_path / WEIGHTS_NAME).read_bytes() == DEFAULT_WEIGHTS.read_bytes()


def test_the_end_of_a_recording_is_not_learned_from(adapted, recording):
    own = open_own_recording(recording, adapted / recording.name)
    count, end = len(own.judged), own.judged.queries
    assert end.tolist() == list(range(round(0.7 * count), count))
    assert not own.same[end].any() and not own.beyond[end].any()
    assert own.same.any()
    assert (own.same == own.same.T).all() and (own.beyond == own.beyond.T).all()
    assert not (own.same & own.beyond).any()
    assert not own.same.diagonal().any()


def test_views_that_share_nothing_in_sight_are_not_taken_for_one_place(
    adapted, recording, monkeypatch
):
    everything = open_own_recording(recording, adapted / recording.name).same
    monkeypatch.setattr(own_recording, "LEAST_OVERLAP", 0.9)
    with_much_in_sight = open_own_recording(recording, adapted / recording.name).same
    assert everything[with_much_in_sight].all()
    assert with_much_in_sight.sum() < everything.sum()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "adapt needs at least one recording"),
        (["fr1_dsk"], "no recording in the format of TUM RGB-D: fr1_dsk; did you mean fr1_desk"),
        (["{tmp}"], "give a folder with rgb.txt and depth.txt"),
        (["{recording}", "{recording}"], "two recordings are named recording; rename one"),
        (["{recording}", "--weights", "{tmp}/none.safetensors"], "none.safetensors"),
    ],
)
def test_what_cannot_be_adapted_to_is_told_in_one_line(
    arguments, message, recording, tmp_path, capsys
):
    named = [each.format(tmp=tmp_path, recording=recording) for each in arguments]
    assert main(["adapt", *named, "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err
    assert message in told and told.count("\n") == 1


def test_a_recording_without_poses_or_without_return_is_refused(
    adapted, recording, tmp_path, capfd
):
    """Of the way there alone the end shows nothing that was seen before."""
    there, black = tmp_path / "there", tmp_path / "black"
    shutil.copytree(recording, there)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        lines = (there / name).read_text().splitlines(keepends=True)
        (there / name).write_text("".join(lines[: len(lines) // 2]))
    run = tmp_path / "out" / "there"
    shutil.copytree(adapted / recording.name, run)
    assert main(["adapt", str(there), "--out", str(tmp_path / "out")]) == 2
    assert "has seen before" in capfd.readouterr().err
    shutil.copytree(recording, black)
    (black / "depth.txt").unlink()
    assert main(["adapt", str(black), "--out", str(tmp_path / "out")]) == 2
    assert "run_slam found no poses (exit code 2)" in capfd.readouterr().err
