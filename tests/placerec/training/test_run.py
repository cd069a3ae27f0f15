# SPDX-License-Identifier: Apache-2.0
"""Training as a user meets it: through `placerec train`."""

import math
import shutil
import signal
import subprocess
import sys
from collections import Counter

import cv2
import numpy as np
import pytest
import torch

from placerec.__main__ import main
from placerec.certificate import read_certificate
from placerec.datasets import LabelledImages, open_dataset
from placerec.networks import TRUNKS, PlaceNetwork
from placerec.recognizers.learned import LearnedRecognizer
from placerec.training.config import Loss, TrainingConfig
from placerec.training.learner import Learner
from placerec.training.log import TrainingLog, read_log

TINY = [
    "--block",
    "stem",
    "--grid",
    "2",
    "2",
    "--size",
    "48",
    "36",
    "--dimension",
    "8",
    "--learning-rate",
    "1e-3",
]
OUTPUTS = ["checkpoint.pt", "log.csv", "log.png", "weights.safetensors"]


@pytest.fixture
def tower(tmp_path):
    """Write clips along walls: 24 images of two floors to train on, 12 of two to test on."""
    rows = ["image_path,floor"]
    clips_of = {"floor1": 2, "floor2": 2, "floor6": 1, "floor11": 1}
    for number, (floor, clips) in enumerate(clips_of.items()):
        for clip in range(clips):
            rng = np.random.default_rng([number, clip])
            wall = np.kron(rng.integers(0, 256, (4, 14, 3), np.uint8), np.ones((12, 12, 1)))
            for frame in range(6):
                path = tmp_path / f"tower/images/{floor}/clip{clip}_frame_{frame:06}.png"
                path.parent.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(path), wall[:, 18 * frame : 18 * frame + 64].astype(np.uint8))
                rows.append(f"{path.relative_to(tmp_path / 'tower')},{floor}")
    (tmp_path / "tower/dataset.csv").write_text("\n".join(rows))
    return tmp_path / "tower"


def _train(data, out, *more, steps=6):
    return main(["train", "--out", str(out), *TINY, "--steps", str(steps), str(data), *more])


def _files(folder):
    return sorted(path.name for path in folder.iterdir())


def _interrupt_at(monkeypatch, kind, method, calls):
    """Press Ctrl-C within so manieth a call, once."""
    count, original = Counter(), getattr(kind, method)

    def interrupted(*arguments):
        count[method] += 1
        if count[method] == calls:
            signal.raise_signal(signal.SIGINT)
        return original(*arguments)

    monkeypatch.setattr(kind, method, interrupted)


def test_leaves_weights_that_recognise_a_log_and_its_plot(tower, tmp_path, capsys):
    out = tmp_path / "new" / "run"
    assert _train(tower, out) == 0
    assert _files(out) == OUTPUTS
    assert "max_steps is reached" in capsys.readouterr().out
    assert [record.step for record in read_log(out / "log.csv")] == [1, 2, 3, 4, 5, 6]
    weights = out / "weights.safetensors"
    assert LearnedRecognizer(weights).embed(open_dataset(str(tower))[0]).shape == (8,)
    apart = ["--out", str(tmp_path / "evaluation"), "--no-cache"]
    assert main(["evaluate", str(tower), "--recognizers", str(weights), *apart]) == 0
    assert f"| tower:test | {weights} |" in capsys.readouterr().out


def test_calibrating_gives_the_weights_their_threshold_and_its_evidence(tower, tmp_path, capsys):
    assert _train(tower, tmp_path / "run", steps=1) == 0
    weights, apart = tmp_path / "run/weights.safetensors", tmp_path / "apart.json"
    fresh, command = weights.read_bytes(), ["calibrate", str(tower), "--recognizer", str(weights)]
    assert main([*command, "--out", str(apart)]) == 0
    assert weights.read_bytes() == fresh and _files(tmp_path / "run") == OUTPUTS
    assert main(command) == 0
    certificate = LearnedRecognizer(weights).certificate
    assert certificate == read_certificate(apart)
    assert (certificate.recognizer, certificate.data) == ("weights.safetensors", "tower:test")
    assert LearnedRecognizer(weights).min_similarity == certificate.min_similarity
    assert _files(tmp_path / "run") == sorted([*OUTPUTS, "weights.certificate.json"])
    assert f"min_similarity written to {weights}\n" in capsys.readouterr().out
    assert main([*command, "--out", str(apart)]) == 0
    assert read_certificate(apart) == certificate  # it is not of the threshold in the file
    assert _train(tower, tmp_path / "run", steps=1) == 0  # nothing is left to do
    assert LearnedRecognizer(weights).min_similarity == certificate.min_similarity
    assert _train(tower, tmp_path / "run", steps=2) == 0
    assert LearnedRecognizer(weights).min_similarity == 0.8  # the evidence was of other weights


def test_words_are_found_in_the_images_and_then_learn(tower, tmp_path, monkeypatch):
    starts = []
    original = Learner.__init__

    def spy(self, network, *others):
        starts.append(network.pool[-1].centroids.detach().clone())
        original(self, network, *others)

    monkeypatch.setattr(Learner, "__init__", spy)
    assert _train(tower, tmp_path / "run", "--words", "4", "--gamma-prime", "2") == 0
    network = LearnedRecognizer(tmp_path / "run/weights.safetensors").network
    assert network.words == 4
    # Means of unit vectors without negative values, unlike the random start.
    assert (starts[0].norm(dim=1) <= 1.0 + 1e-6).all() and starts[0].norm(dim=1).min() > 0.5
    assert not torch.equal(network.pool[-1].centroids, starts[0].half().float())


def test_no_step_leaves_what_a_training_starts_from(tower, tmp_path, monkeypatch):
    looked_at = []

    def spy(self, count, progress):
        looked_at.append(self.network.fully_connected.merged().weight.detach().clone())

    monkeypatch.setattr(Learner, "look_at_all", spy)
    assert _train(tower, tmp_path / "run", steps=0) == 0
    assert _files(tmp_path / "run") == OUTPUTS
    assert read_log(tmp_path / "run/log.csv") == []
    network = LearnedRecognizer(tmp_path / "run/weights.safetensors").network
    assert torch.equal(network.fully_connected.weight, looked_at[0].half().float())


def test_the_last_layer_starts_at_random_where_asked_for(tower, tmp_path):
    for name, more in (("usual", ()), ("random", ("--random-last-layer",))):
        assert _train(tower, tmp_path / name, *more, steps=0) == 0
    usual, random = (
        LearnedRecognizer(tmp_path / name / "weights.safetensors").network.fully_connected.weight
        for name in ("usual", "random")
    )
    trunk = TRUNKS["mobilenet_v2"]
    untouched = PlaceNetwork(trunk, 8, block="stem", grid=(2, 2), size_px=(48, 36), seed=0)
    assert torch.equal(random, untouched.fully_connected.weight.half().float())
    assert not torch.allclose(usual, random, atol=0.1)


def test_each_of_the_data_is_a_collection_and_may_be_many_recordings(tower, tmp_path, monkeypatch):
    for name in ("one", "two"):
        copy = tmp_path / "towers" / name
        shutil.copytree(tower, copy)
    learned_from = []
    original = Learner.__init__

    def spy(self, network, images, *others):
        learned_from.append(images)
        original(self, network, images, *others)

    monkeypatch.setattr(Learner, "__init__", spy)
    assert _train(tmp_path / "towers", tmp_path / "run", str(tower), steps=1) == 0
    (images,) = learned_from
    np.testing.assert_array_equal(images.collections, [0] * 48 + [1] * 24)
    np.testing.assert_array_equal(images.scenes, [0] * 24 + [1] * 24 + [2] * 24)


def test_same_command_same_bytes_and_another_seed_others(tower, tmp_path):
    for name, seed in (("a", "0"), ("b", "0"), ("c", "1")):
        assert _train(tower, tmp_path / name, "--seed", seed, steps=2) == 0
    a, b, c = ((tmp_path / name / "weights.safetensors").read_bytes() for name in "abc")
    assert a == b != c


def test_clips_are_those_for_training_unless_others_are_named(tower, tmp_path, monkeypatch):
    seen = set()
    original = LabelledImages.__init__

    def spy(self, *collections):
        seen.update(dataset.name for each in collections for dataset in each)
        original(self, *collections)

    monkeypatch.setattr(LabelledImages, "__init__", spy)
    assert _train(tower, tmp_path / "run", f"{tower}:test", steps=1) == 0
    assert seen == {"tower:train", "tower:test"}


@pytest.mark.parametrize(
    ("kind", "method", "calls"),
    [
        (LabelledImages, "__getitem__", 1),  # of the principal components
        (LabelledImages, "__getitem__", 30),  # of the first round's sets
        (TrainingLog, "add", 3),  # a step
        (LabelledImages, "__getitem__", 24 + 24 + 2 * 40 + 5),  # of the second round's sets
    ],
)
def test_ctrl_c_is_one_line_and_the_same_command_goes_on(
    tower, tmp_path, capsys, kind, method, calls
):
    assert _train(tower, tmp_path / "whole") == 0
    capsys.readouterr()
    before = signal.getsignal(signal.SIGINT)
    with pytest.MonkeyPatch.context() as patch:
        _interrupt_at(patch, kind, method, calls)
        assert _train(tower, tmp_path / "parts") == 2
    assert signal.getsignal(signal.SIGINT) is before
    error = capsys.readouterr().err
    assert error == f"placerec: stopped; the same command goes on from here: {tmp_path / 'parts'}\n"
    done = len(read_log(tmp_path / "parts" / "log.csv"))
    assert done < 6
    assert (tmp_path / "parts" / "checkpoint.pt").exists() is (done > 0 or calls == 30)
    with pytest.MonkeyPatch.context() as patch:
        again = []
        original = TrainingLog.add
        patch.setattr(
            TrainingLog, "add", lambda log, record: (again.append(record), original(log, record))
        )
        assert _train(tower, tmp_path / "parts") == 0
    assert [record.step for record in again] == list(range(done + 1, 7))
    whole, parts = (tmp_path / name / "weights.safetensors" for name in ("whole", "parts"))
    assert whole.read_bytes() == parts.read_bytes()


def test_bar_tells_loss_sets_left_rate_and_time_to_go(tower, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("COLUMNS", "200")
    assert _train(tower, tmp_path / "run", steps=2) == 0
    shown = capsys.readouterr().err
    assert "looking at image 24 of 24" in shown
    last = shown.split("\r")[-2] if "min to go" in shown.split("\r")[-2] else shown
    assert "loss 0." in last and " sets left, " in last and " images/s, 0.0 min to go" in last


def test_every_loss_can_be_named(tower, tmp_path):
    assert TrainingConfig().loss == Loss.SIMPLIFIED
    for loss in Loss:
        assert _train(tower, tmp_path / loss, "--loss", loss, steps=1) == 0


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--weights", "none.npz"], "cannot read the weights: No such file or directory: none.npz"),
        (["--trunk", "resnet"], "there is no trunk 'resnet'; there are: alexnet, vgg16, "),
        (["--block", "block99"], "trunk 'mobilenet_v2' has no block 'block99'; it has: stem, "),
        (["--frozen-block", "block3"], "--frozen-block 'block3': the network is cut before it"),
        (["--loss", "hinge"], "--loss 'hinge': input should be 'multi-constraint', "),
        (["--steps", "-1"], "--steps -1: input should be greater than or equal to 0"),
        (["--minutes", "-1"], "--minutes -1.0: input should be greater than 0"),
        (["--learning-rate", "0"], "--learning-rate 0.0: input should be greater than 0"),
        (["--grid", "0", "2"], "--grid 0 2: both numbers must be at least 1"),
        (["--size", "64", "-1"], "--size 64 -1: both numbers must be at least 1"),
        (["--dimension", "0"], "--dimension 0: an embedding needs at least 1 value"),
        (["--out", "/dev/null/run"], "cannot make the folder: Not a directory: /dev/null/run"),
    ],
)
def test_bad_input_is_one_line_and_leaves_nothing(tower, tmp_path, capsys, more, message):
    assert _train(tower, tmp_path / "run", *more) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"placerec: {message}")
    assert error.count("\n") == 1
    assert not (tmp_path / "run" / "checkpoint.pt").exists()


def test_bad_data_is_one_line(tower, tmp_path, write_image, capsys):
    for i in range(2):
        write_image(tmp_path / f"drives/query/{i}.png", seed=i)
        write_image(tmp_path / f"drives/ref/{i}.png", seed=i)
    (tmp_path / "drives/ground_truth.csv").write_text("query,refs\n0,0\n1,1\n")
    out = ["--out", str(tmp_path / "run"), *TINY]
    for data, message in (
        ([], "train needs at least one folder"),
        ([str(tower), str(tmp_path / "drives")], "drives tells only which pairs of images show"),
        ([str(tower), str(tower)], "tower:train and tower:train have an image in common"),
        ([f"{tower}:test"], "the images show 4 places, and 5 are needed"),
        ([str(tmp_path / "none")], "there is no such folder"),
    ):
        assert main(["train", *data, *out]) == 2
        error = capsys.readouterr().err
        assert error.startswith(f"placerec: {message}")
        assert error.count("\n") == 1


def test_broken_images_are_named_and_left_out(tower, tmp_path, capsys):
    broken = tower / "images/floor1/clip0_frame_000002.png"
    broken.write_bytes(broken.read_bytes()[:100])
    assert _train(tower, tmp_path / "run", steps=1) == 0
    shown = capsys.readouterr()
    assert f"skipped: the file is cut off: {broken}" in shown.err
    assert "learned from 23 images (1 skipped)\n" in shown.out


def test_images_of_any_size_and_kind_are_learned_from(tower, tmp_path):
    floor = tower / "images/floor1"
    shapes = [(1, 1, 3), (300, 5, 3), (40, 60), (40, 60, 4), (2, 700, 3)]
    for frame, shape in enumerate(shapes):
        image = np.random.default_rng(frame).integers(0, 256, shape, np.uint8)
        assert cv2.imwrite(str(floor / f"clip0_frame_{frame:06}.png"), image)
    assert _train(tower, tmp_path / "run", steps=2) == 0
    weights = LearnedRecognizer(tmp_path / "run/weights.safetensors")
    for image in open_dataset(f"{tower}:train"):
        assert np.linalg.norm(weights.embed(image)) == pytest.approx(1.0, abs=1e-4)


def test_loss_that_is_no_number_is_one_line_and_keeps_the_last_good_checkpoint(
    tower, tmp_path, capsys, monkeypatch
):
    out, original = tmp_path / "run", Learner.work_out_gradients
    assert _train(tower, out, steps=2) == 0
    capsys.readouterr()

    def breaks(self, batch, step):
        return original(self, batch, step) if step < 3 else (math.nan, 1.0, False)

    monkeypatch.setattr(Learner, "work_out_gradients", breaks)
    assert _train(tower, out, steps=5) == 2
    error = capsys.readouterr().err
    assert error.startswith("placerec: the training broke down at step 4: the loss is nan or a ")
    assert error.count("\n") == 1
    monkeypatch.undo()
    assert len(read_log(out / "log.csv")) == 3
    assert _train(tower, out, steps=4) == 0
    assert [record.step for record in read_log(out / "log.csv")] == [1, 2, 3, 4]


def test_weights_of_another_network_or_a_pickle_are_refused(tower, tmp_path, capsys):
    np.savez(tmp_path / "other.npz", conv99=np.zeros(3))
    (tmp_path / "code.pth").write_bytes(b"cos\nsystem\n(S'true'\ntR.")
    for name, message in (
        ("other.npz", "not weights of mobilenet_v2: there is no conv00.weight"),
        ("code.pth", "the weights file is damaged, or a pickle that would run code"),
    ):
        assert _train(tower, tmp_path / "run", "--weights", str(tmp_path / name)) == 2
        assert capsys.readouterr().err.startswith(f"placerec: {message}")


def test_folder_of_another_training_or_table_is_refused(tower, tmp_path, capsys):
    assert _train(tower, tmp_path / "run", steps=1) == 0
    for more in (["--dimension", "9"], ["--grid", "1", "4"], ["--size", "44", "36"]):
        assert _train(tower, tmp_path / "run", *more) == 2
        error = capsys.readouterr().err
        assert error.startswith("placerec: the checkpoint is of another training: its network is")
    weights = tmp_path / "weights.safetensors"
    shutil.copy(tmp_path / "run/weights.safetensors", weights)
    assert _train(tower, tmp_path / "run", "--weights", str(weights)) == 2
    assert "its start is random weights, not " in capsys.readouterr().err
    renamed = tmp_path / "renamed"
    shutil.copytree(tower, renamed)
    for image in renamed.glob("images/*/clip0_*"):
        image.rename(image.with_name(image.name.replace("clip0", "clip9")))
    table = renamed / "dataset.csv"
    table.write_text(table.read_text().replace("clip0", "clip9"))
    assert _train(renamed, tmp_path / "run") == 2
    assert "its names of images is " in capsys.readouterr().err
    (tmp_path / "sheets").mkdir()
    (tmp_path / "sheets/log.csv").write_text("name,price\nbolt,3\n")
    assert _train(tower, tmp_path / "sheets") == 2
    assert capsys.readouterr().err.startswith("placerec: the file is no log of a training")


def test_flags_need_no_torch():
    code = "import sys, placerec.commands.train; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
