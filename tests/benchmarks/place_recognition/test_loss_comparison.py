# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from benchmarks.place_recognition import loss_comparison
from benchmarks.place_recognition.loss_comparison import DRAWN, OURS, SAME_SETS, WAYS, main
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


@pytest.fixture
def compare(scenes, monkeypatch, capsys):
    """Return what compares losses on a small network, by some options: what it printed."""
    monkeypatch.setattr(loss_comparison, "load_pretrained", lambda *_: None)
    monkeypatch.setattr(loss_comparison, "BLOCK", "block1")
    monkeypatch.setattr(loss_comparison, "SIZE_PX", (32, 24))
    monkeypatch.setattr(loss_comparison, "DIMENSION", 16)
    argv = ["x", f"{scenes}/scenes"]

    def told(*options, data=("paths",)):
        everything = [*argv, *(f"{scenes}/{kind}" for kind in data), "--mobilenet", "none"]
        everything += ["--work", f"{scenes}/work", "--steps", "10", *options]
        monkeypatch.setattr("sys.argv", everything)
        assert main() == 0
        return capsys.readouterr().out

    return told


def test_all_ways_start_from_one_layer_and_are_compared_seed_by_seed(scenes, compare):
    told = compare("--seeds", "2")
    assert all(way in told for way in WAYS)
    gains = told.splitlines()[2]
    assert gains.startswith("| paths | ") and gains.count(" % (") == 2
    curves = _curves(scenes, "block1")
    assert len(curves) == 3 and all(curve.shape == (5, 1) for curve in curves)
    assert curves[0][0] == curves[1][0] == curves[2][0]
    assert not np.array_equal(curves[0], curves[1])
    assert "steps | | 0 | 2 | 5 | 7 | 10 |" in told
    ours = told.splitlines()[-3]
    means = np.mean([_curves(scenes, "block1", seed)[0] for seed in (0, 1)], axis=0)
    assert ours == f"| paths | {OURS} | {' | '.join(f'{mean:.3f}' for mean in means[:, 0])} |"
    assert compare("--seeds", "2") == told  # from what was kept
    more = compare("--seeds", "1", "--same-sets-only", data=("scenes", "paths"))
    kinds = [line.split(" | ")[0] for line in more.splitlines()[2:4]]
    assert kinds == ["| scenes", "| paths"]  # and not from that, whose columns are others


def test_blocks_behind_a_frozen_one_learn_from_the_same_start(scenes, compare):
    told = compare("--seeds", "1", "--same-sets-only", "--frozen-block", "block0")
    assert DRAWN not in told
    learned = _curves(scenes, "block0")
    assert len(learned) == 2 and learned[0][0] == learned[1][0]
    compare("--seeds", "1", "--same-sets-only")
    fixed = _curves(scenes, "block1")
    np.testing.assert_allclose(learned[0][0], fixed[0][0], atol=2e-3)  # other maps are rounded
    assert not np.allclose(learned[0][1:], fixed[0][1:], atol=1e-6)


def test_each_way_is_shown_at_the_rate_that_suits_it(scenes, compare):
    ways, rates = (OURS, SAME_SETS), ("5e-05", "0.0001")
    options = ("--seeds", "2", "--same-sets-only", "--learning-rate", *rates)
    compare(*options)
    learned = {tuple(_mean_curve(scenes, way, rate)) for way in ways for rate in rates}
    assert len(learned) == 4
    for way, rate in zip(ways, rates, strict=True):
        for file in _files(scenes, way, rate):
            np.save(file, 1.0 + np.load(file))  # which no other rate reaches
    told = compare(*options).splitlines()
    assert told[-1] == f"Rates, chosen on paths: {OURS} 5e-05; {SAME_SETS} 0.0001"
    curves = [_mean_curve(scenes, way, rate) for way, rate in zip(ways, rates, strict=True)]
    assert told[2].split(" | ")[2:4] == [f"{curve[-1]:.3f}" for curve in curves]
    for way, curve in zip(ways, curves, strict=True):
        assert f"| paths | {way} | {' | '.join(f'{each:.3f}' for each in curve)} |" in told


def _files(scenes, way, rate):
    """Return where the curves of a way's seeds are kept."""
    name = way.replace(", ", "-")
    return sorted((scenes / "work" / "block1").glob(f"{name}-seed*-{rate}-*.npy"))


def _mean_curve(scenes, way, rate):
    """Return the (5,) mean of what is kept of a way's seeds."""
    return np.mean([np.load(file)[:, 0] for file in _files(scenes, way, rate)], axis=0)


def test_a_rate_is_chosen_by_the_mean_of_all_seeds_at_the_end_on_the_first_of_the_data():
    def curve(end, elsewhere):
        return np.array([[0.9, 0.9], [end, elsewhere]])  # better at the start, to no avail

    by_rate = {
        (1e-5, 0): curve(0.3, 0.9),
        (1e-5, 1): curve(0.3, 0.9),
        (1e-4, 0): curve(0.2, 0.1),
        (1e-4, 1): curve(0.6, 0.1),
        (1e-3, 0): curve(0.35, 0.5),
        (1e-3, 1): curve(0.35, 0.5),
    }
    assert loss_comparison._best_rate(by_rate, range(2)) == 1e-4
    assert loss_comparison._best_rate(by_rate, range(1)) == 1e-3


def test_where_all_places_are_told_apart_it_ends(compare):
    with pytest.raises(SystemExit, match="multi-constraint, seed 0: no set can be built"):
        compare("--seeds", "1", "--same-sets-only", "--learning-rate", "0.1", "--steps", "1000")


def test_a_block_behind_the_last_is_refused(compare, capsys):
    with pytest.raises(SystemExit) as stop:
        compare("--frozen-block", "block2")
    assert stop.value.code == 2 and "block0" in capsys.readouterr().err


def _curves(scenes, frozen_block, seed=0):
    """Return the kept curves of a seed, in the order of their names: ours, drawn, same sets."""
    folder = scenes / "work" / frozen_block
    return [np.load(file) for file in sorted(folder.glob(f"*-seed{seed}-10-*.npy"))]


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
