# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from benchmarks.place_recognition import loss_comparison
from benchmarks.place_recognition.loss_comparison import WAYS, main
from benchmarks.training_scenes.handheld import write_folder
from placerec.networks import TRUNKS


@pytest.fixture
def scenes(tmp_path):
    """Return folders of views of coloured boards: two scenes to learn from, one path."""
    rng = np.random.default_rng(0)

    def views(seconds_apart, seed):
        for place in range(14):
            board = np.random.default_rng([seed, place]).integers(0, 256, (6, 8, 3), np.uint8)
            for view in range(3):
                noisy = board.repeat(8, 0).repeat(8, 1) // 2 + rng.integers(0, 90, (48, 64, 3))
                T_world_cam = np.eye(4)
                T_world_cam[:3, 3] = 2.0 * place, 0.1 * view, 0.0
                time_s = seconds_apart * (14 * view + place)
                yield 100.0 + time_s, noisy.astype(np.uint8), T_world_cam, place

    for kind, names in (("scenes", ("a", "b")), ("paths", ("c",))):
        for seed, name in enumerate(names):
            (tmp_path / kind).mkdir(exist_ok=True)
            write_folder(tmp_path / kind / name, sorted(views(4.0, seed), key=lambda v: v[0]))
    return tmp_path


def test_all_ways_start_from_one_layer_and_are_compared_seed_by_seed(scenes, monkeypatch, capsys):
    monkeypatch.setattr(loss_comparison, "load_pretrained", lambda *_: None)
    monkeypatch.setattr(loss_comparison, "BLOCK", "block1")
    monkeypatch.setattr(loss_comparison, "SIZE_PX", (32, 24))
    monkeypatch.setattr(loss_comparison, "DIMENSION", 16)
    argv = ["x", f"{scenes}/scenes", f"{scenes}/paths", "--mobilenet", "none", "--seeds", "2"]
    argv += ["--work", f"{scenes}/work", "--steps", "10"]
    monkeypatch.setattr("sys.argv", argv)
    assert main() == 0
    told = capsys.readouterr().out
    assert all(way in told for way in WAYS)
    assert "| paths | " in told.splitlines()[-1] and told.count(" % (") == 2
    curves = [np.load(file) for file in sorted((scenes / "work").glob("*-seed0-10.npy"))]
    assert len(curves) == 3 and all(curve.shape == (11, 1) for curve in curves)
    assert curves[0][0] == curves[1][0] == curves[2][0]
    assert not np.array_equal(curves[0], curves[1])
    assert main() == 0  # from what was kept
    assert capsys.readouterr().out == told


def test_a_drawn_set_is_of_one_place_and_of_others():
    truth = np.kron(np.eye(5), np.ones((3, 3))).astype(np.bool_)
    sets = loss_comparison._drawn(truth, ~truth, np.arange(15), np.random.default_rng(0))
    assert sets.positives.shape == sets.negatives.shape == (15, 4)
    places = np.arange(15) // 3
    assert (places[sets.positives] == places[:, None]).all()
    assert (places[sets.negatives] != places[:, None]).all()


def test_the_interval_is_that_of_the_paired_gains():
    ours, theirs = np.array([1.1, 1.2, 1.3]), np.ones(3)
    assert loss_comparison._gain(ours, theirs) == "+20.0 % (-4.8 to +44.8)"
    assert loss_comparison._gain(ours[:1], theirs[:1]) == "+10.0 %"


def test_networks_are_there():
    assert loss_comparison.BLOCK in TRUNKS["mobilenet_v2"].blocks
