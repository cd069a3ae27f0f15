# SPDX-License-Identifier: Apache-2.0
import csv
import os
import signal
import subprocess
import sys
import textwrap
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import nn

from placerec.datasets.labelled_images import PairTruth
from placerec.errors import LoopcloseError, RecognizerError
from placerec.networks import PlaceNetwork, Preprocessing, Trunk
from placerec.networks.whitening import whiten
from placerec.training import loop
from placerec.training.config import Loss, TrainingConfig
from placerec.training.image_sets import ImageSets, build_image_sets
from placerec.training.loop import End, Training

ROOT = Path(__file__).parents[3]


def _layers():
    return nn.Sequential(
        nn.Conv2d(3, 8, 3, stride=2), nn.ReLU(), nn.Conv2d(8, 8, 3), nn.ReLU(), nn.Dropout(0.1)
    )


TINY = Trunk(
    "tiny", _layers, Preprocessing(24, 18, (128.0,) * 3, (64.0,) * 3), {"first": 2, "second": 5}
)
FAST = {"learning_rate": 3e-3, "trunk_learning_rate": 1e-3}


class Boards:
    """Places that are boards of coloured squares, seen shifted and in other light."""

    def __init__(self, places=12, views=5, seed=0):
        rng = np.random.default_rng(seed)
        boards = rng.integers(0, 200, (places, 5, 6, 3))
        self.places = np.repeat(np.arange(places), views)
        self.scenes = self.places % 2
        self.collections = np.zeros_like(self.places)
        self.reads = 0
        self._views = []
        for place in self.places:
            large = np.kron(boards[place], np.ones((6, 6, 1)))
            dy, dx = rng.integers(0, 7, 2)
            view = large[dy : dy + 24, dx : dx + 30] * rng.uniform(0.8, 1.2)
            self._views.append(np.clip(view, 0, 255).astype(np.uint8))

    def around(self, anchors, of_place, just_beyond, rng):
        drawn = [rng.permutation(np.flatnonzero(self.places == self.places[i])) for i in anchors]
        return np.unique([*anchors, *(i for each in drawn for i in each[:of_place])])

    def pairs(self, indices):
        same = self.places[indices, None] == self.places[indices]
        return PairTruth(same, ~same, np.zeros_like(same))

    def __getitem__(self, index):
        self.reads += 1
        return self._views[index]


def _train(folder, images=None, network=None, steps=None, **config):
    network = network or PlaceNetwork(TINY, 16)
    folder.mkdir(exist_ok=True)
    training = Training(network, images or Boards(), TrainingConfig(**(FAST | config)), folder)
    records = []
    for record in training:
        records.append(record)
        if len(records) == steps:
            break
    return training, records


def _same(a, b):
    a, b = a.state_dict(), b.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


@pytest.mark.parametrize("loss", list(Loss))
def test_learns_to_tell_places_apart(tmp_path, loss):
    training, records = _train(tmp_path / "run", loss=loss, max_steps=120)
    early = np.mean([record.loss for record in records[:5]])
    late = np.mean([record.loss for record in records[-5:]])
    assert late < 0.6 * early
    assert training.end is (End.STEPS if len(records) == 120 else End.LEARNED)
    assert not training.network.training


def test_ends_when_no_set_can_be_formed(tmp_path):
    images = Boards(places=6, views=3)
    faster = {"learning_rate": 1e-2, "trunk_learning_rate": 3e-3}
    training, records = _train(
        tmp_path / "run", images, max_steps=2000, images_per_place=99, **faster
    )
    assert training.end is End.LEARNED
    assert 5 < len(records) < 2000
    assert records[-1].sets_left == 0


def test_ends_on_a_budget_of_time(tmp_path):
    training, records = _train(tmp_path / "run", minutes=1e-9)
    assert training.end is End.SECONDS
    assert records == []


def test_records_say_how_far_it_is(tmp_path):
    _, records = _train(tmp_path / "run", max_steps=4)
    assert [record.step for record in records] == [1, 2, 3, 4]
    assert [record.sets_left for record in records] == [7, 2, 0, 7]
    assert [record.round for record in records] == [1, 1, 1, 2]
    assert records[-1].time_to_go_s == 0.0
    assert all(record.time_to_go_s > 0 for record in records[:-1])
    assert all(0.0 < record.active_share <= 1.0 for record in records)


def test_same_seed_same_network_and_the_callers_random_numbers_are_left_alone(tmp_path):
    torch.manual_seed(1)
    expected = torch.rand(2)
    torch.manual_seed(1)
    first, _ = _train(tmp_path / "a", max_steps=5)
    assert torch.equal(torch.rand(2), expected)
    again, _ = _train(tmp_path / "b", max_steps=5)
    other, _ = _train(tmp_path / "c", max_steps=5, seed=1)
    assert _same(first.network, again.network)
    assert not _same(first.network, other.network)


@pytest.mark.parametrize(
    "config",
    [
        {},
        {"augment": True},
        {"frozen_block": "first"},
        {"frozen_block": "first", "augment": True, "loss": Loss.TRIPLET},
    ],
)
def test_stopping_and_going_on_changes_nothing(tmp_path, config):
    whole, records = _train(tmp_path / "whole", max_steps=9, **config)
    _train(tmp_path / "parts", max_steps=9, steps=4, **config)
    network = PlaceNetwork(TINY, 16, seed=9)  # what it starts from is in the checkpoint
    parts, rest = _train(tmp_path / "parts", network=network, max_steps=9, **config)
    assert [record.step for record in rest] == [5, 6, 7, 8, 9]
    assert [record.loss for record in rest] == [record.loss for record in records[4:]]
    assert _same(whole.network, parts.network)


KILLED = """
    import sys
    sys.path[:0] = [{root!r}, {tests!r}]
    from pathlib import Path
    from test_loop import TINY, Boards, FAST
    from placerec.networks import PlaceNetwork
    from placerec.training.loop import Training
    from placerec.training.config import TrainingConfig
    from placerec.training import loop
    import os, signal
    loop.CHECKPOINT_INTERVAL_S = 0.0
    config = TrainingConfig(**FAST, max_steps=9)
    for record in Training(PlaceNetwork(TINY, 16), Boards(), config, Path({folder!r})):
        if record.step == 5:
            os.kill(os.getpid(), signal.SIGKILL)
"""


def _script(tmp_path, text, **values):
    path = tmp_path / "script.py"
    values |= {"root": str(ROOT), "tests": str(Path(__file__).parent)}
    path.write_text(textwrap.dedent(text.format(**values)))
    return path


def test_killed_training_goes_on_to_the_same_result(tmp_path):
    folder = tmp_path / "killed"
    folder.mkdir()
    script = _script(tmp_path, KILLED, folder=str(folder))
    environment = os.environ | {"OMP_NUM_THREADS": str(torch.get_num_threads())}
    killed = subprocess.run([sys.executable, str(script)], env=environment, check=False)
    assert killed.returncode == -signal.SIGKILL
    assert sorted(path.name for path in folder.iterdir()) == ["checkpoint.pt", "log.csv"]
    resumed, records = _train(folder, max_steps=9)
    assert records[0].step == 5  # the step after the last checkpoint is made again
    whole, _ = _train(tmp_path / "whole", max_steps=9)
    assert _same(whole.network, resumed.network)
    with (folder / "log.csv").open() as file:
        assert [int(row["step"]) for row in csv.DictReader(file)] == list(range(1, 10))


TORCHRUN = """
    import sys
    sys.path[:0] = [{root!r}, {tests!r}]
    from pathlib import Path
    import torch
    from torch import nn
    from test_loop import TINY, Boards, FAST
    from placerec.networks import PlaceNetwork, Trunk
    from placerec.training.loop import Training
    from placerec.training.config import TrainingConfig
    from placerec.training.workers import Workers
    workers = Workers()
    assert workers.count == 2
    config = TrainingConfig(**FAST, max_steps=6, minutes=20.0)
    network = PlaceNetwork(TINY, 16).eval()
    network.features[4].p = 0.0
    for record in Training(network, Boards(), config, Path({folder!r}), workers=workers):
        pass
    torch.save(network.state_dict(), Path({folder!r}) / f"rank{{workers.rank}}.pt")
    torch.distributed.barrier()  # who leaves while the other still listens is taken for broken
    torch.distributed.destroy_process_group()
"""


def test_two_processes_learn_what_one_does(tmp_path):
    folder = tmp_path / "two"
    folder.mkdir()
    script = _script(tmp_path, TORCHRUN, folder=str(folder))
    torchrun = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    run = subprocess.run(
        [sys.executable, *torchrun, str(script)],
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stderr
    network = PlaceNetwork(TINY, 16)
    network.features[4].p = 0.0  # what is dropped depends on which process draws
    one, records = _train(tmp_path / "one", network=network, max_steps=6)
    ranks = [torch.load(folder / f"rank{rank}.pt", weights_only=True) for rank in (0, 1)]
    for name, value in one.network.state_dict().items():
        assert torch.equal(ranks[0][name], ranks[1][name])
        torch.testing.assert_close(ranks[0][name], value, atol=1e-4, rtol=1e-3)
    with (folder / "log.csv").open() as file:
        losses = [float(row["loss"]) for row in csv.DictReader(file)]
    np.testing.assert_allclose(losses, [record.loss for record in records], rtol=1e-3)


def test_frozen_layers_stay_and_see_each_image_once(tmp_path):
    images, network = Boards(), PlaceNetwork(TINY, 16)
    before = {name: value.clone() for name, value in network.state_dict().items()}
    _train(tmp_path / "run", images, network, max_steps=8, frozen_block="first")
    assert images.reads == len(images.places)
    after = network.state_dict()
    changed = {name for name in before if not torch.equal(before[name], after[name])}
    assert changed == {name for name in before if not name.startswith("features.0")}
    _train(tmp_path / "again", images, network, max_steps=1)
    assert not torch.equal(before["features.0.weight"], network.state_dict()["features.0.weight"])


def test_frozen_layers_change_nothing_but_what_is_worked_out_when(tmp_path):
    # Cached maps and the layers themselves lead to the same embeddings.
    network = PlaceNetwork(TINY, 16).eval()
    training, _ = _train(tmp_path / "run", network=network, max_steps=3, frozen_block="second")
    images = Boards()
    with torch.inference_mode():
        direct = network(network.prepare([images[i] for i in range(10)]))
    cached = training._learner.embed(np.arange(10))
    np.testing.assert_allclose(cached, direct.numpy(), atol=1e-5)


class _Breaks(nn.Module):
    """Returns NaN from a certain pass with gradients on."""

    def __init__(self, passes):
        super().__init__()
        self.layer, self.left = nn.Conv2d(3, 4, 3), passes

    def forward(self, images):
        self.left -= self.training
        return self.layer(images) * (torch.nan if self.left < 0 else 1.0)


def test_learning_rate_rises_then_falls_to_zero(tmp_path):
    _, records = _train(tmp_path / "run", max_steps=120, gamma_prime=4.0)
    rates = np.array([record.learning_rate for record in records])
    top = int(rates.argmax())
    assert 30 < top < 60
    assert (np.diff(rates[: top + 1]) > 0).all()
    assert (np.diff(rates[top:]) < 0).all()
    assert 0.5 * FAST["learning_rate"] < rates[top] < FAST["learning_rate"]
    assert rates[-1] < 0.01 * FAST["learning_rate"]


def test_a_round_visits_some_places_of_some_scenes(tmp_path):
    config = {"scenes_per_round": 1, "places_per_scene": 5, "batch_sets": 50, "gamma_prime": 4.0}
    training, records = _train(tmp_path / "run", max_steps=6, **config)
    assert [record.round for record in records] == [1, 2, 3, 4, 5, 6]  # a step learns from all
    places = np.concatenate([training._sets.positives, training._sets.negatives], axis=1) // 5
    assert len(np.unique(places)) == 5
    assert len(np.unique(places % 2)) == 1


def test_one_scene_without_sets_is_not_the_end(tmp_path):
    class TwinsInOddScene(Boards):
        """Boards of scene 1 are all alike, so that nothing there is a negative of anything."""

        def pairs(self, indices):
            odd = self.scenes[indices] == 1
            truth = super().pairs(indices)
            return replace(truth, apart=truth.apart & ~(odd[:, None] & odd))

    config = {"scenes_per_round": 1, "batch_sets": 50, "gamma_prime": 4.0}
    training, records = _train(tmp_path / "run", TwinsInOddScene(), max_steps=3, seed=1, **config)
    assert training.end is End.STEPS
    assert records[-1].round > 3  # those without a set were gone through


def test_nan_loss_stops_and_leaves_the_last_good_checkpoint(tmp_path, monkeypatch):
    monkeypatch.setattr(loop, "CHECKPOINT_INTERVAL_S", 0.0)
    trunk = Trunk("breaks", lambda: _Breaks(4), TINY.preprocessing)
    network = PlaceNetwork(trunk, 8).eval()
    with pytest.raises(RecognizerError, match="broke down at step 4: the loss is nan") as error:
        _train(tmp_path / "run", network=network, max_steps=9)
    assert "\n" not in str(error.value)
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert state["step"] == 2
    assert all(bool(value.isfinite().all()) for value in state["network"].values())
    sound = PlaceNetwork(Trunk("breaks", lambda: _Breaks(99), TINY.preprocessing), 8)
    training, records = _train(tmp_path / "run", network=sound, max_steps=9, learning_rate=1e-3)
    assert records[0].step == 3
    assert training.end is End.STEPS


def test_weights_too_large_for_a_file_stop_and_leave_the_last_good_checkpoint(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(loop, "CHECKPOINT_INTERVAL_S", 0.0)
    _train(tmp_path / "run", max_steps=1)
    with pytest.raises(
        RecognizerError, match=r"weights have grown .* lower learning_rate"
    ) as error:
        _train(tmp_path / "run", max_steps=30, learning_rate=1e8)
    assert "\n" not in str(error.value)
    _training, records = _train(tmp_path / "run", max_steps=3)
    assert [record.step for record in records] == [2, 3]


def test_one_round_without_sets_is_not_the_end(tmp_path, monkeypatch):
    rounds = []

    def few(*arguments):
        rounds.append(arguments)
        found = build_image_sets(*arguments)
        return found if len(rounds) % 3 == 0 else ImageSets(*np.empty((2, 0, 4), np.int64))

    monkeypatch.setattr(loop, "build_image_sets", few)
    training, records = _train(tmp_path / "run", max_steps=2, batch_sets=999)
    assert training.end is End.STEPS
    assert records[0].round == 3


def test_place_with_one_image_is_learned_from(tmp_path):
    images = Boards(places=8, views=1)
    training, _ = _train(tmp_path / "run", images, max_steps=3)
    assert training.end in (End.STEPS, End.LEARNED)


def test_too_few_places_for_a_set_are_one_line(tmp_path):
    with pytest.raises(RecognizerError, match="show 4 places, and 5 are needed"):
        _train(tmp_path / "run", Boards(places=4))


def test_checkpoint_of_another_training_is_refused(tmp_path):
    _train(tmp_path / "run", max_steps=2)
    with pytest.raises(RecognizerError, match=r"its alpha is 0\.5, not 0\.2"):
        _train(tmp_path / "run", alpha=0.2)
    with pytest.raises(RecognizerError, match=r"its augmentation is null, not {\"brightness"):
        _train(tmp_path / "run", augment=True)
    with pytest.raises(RecognizerError, match=r"its images is 60 with labels .*, not 65 with"):
        _train(tmp_path / "run", Boards(places=13))
    with pytest.raises(RecognizerError, match="its network is"):
        _train(tmp_path / "run", network=PlaceNetwork(TINY, 17))
    whitened = PlaceNetwork(TINY, 16)
    whiten(whitened, torch.randn(30, whitened.fully_connected.in_features))
    with pytest.raises(RecognizerError, match="its last layer is random at first, not whitened"):
        _train(tmp_path / "run", network=whitened)
    _, records = _train(tmp_path / "run", max_steps=3, learning_rate=1e-4)
    assert [record.step for record in records] == [3]


@pytest.mark.parametrize(
    "change",
    [
        {"network": 5},
        {"step": "2"},
        {"positives": [1]},
        {"optimizer": {}},
        {"network": {}},
        {"x": 1},
    ],
)
def test_checkpoint_of_wrong_types_is_refused(tmp_path, change):
    _train(tmp_path / "run", max_steps=1)
    path = tmp_path / "run" / "checkpoint.pt"
    torch.save(torch.load(path, weights_only=True) | change, path)
    with pytest.raises(RecognizerError, match="remove it to start anew"):
        _train(tmp_path / "run", max_steps=2)


def test_damaged_checkpoint_is_refused(tmp_path):
    _train(tmp_path / "run", max_steps=2)
    path = tmp_path / "run" / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(RecognizerError, match="checkpoint is damaged; remove it"):
        _train(tmp_path / "run", max_steps=3)


def test_frozen_block_must_be_in_the_network(tmp_path):
    with pytest.raises(RecognizerError, match="no block 'third'"):
        _train(tmp_path / "run", frozen_block="third")
    cut = PlaceNetwork(TINY, 4, block="first")
    with pytest.raises(RecognizerError, match="cut before it, after 'first'"):
        _train(tmp_path / "run", network=cut, frozen_block="second")


def test_folder_must_exist(tmp_path):
    with pytest.raises(LoopcloseError, match=r"cannot write log\.csv"):
        Training(PlaceNetwork(TINY, 4), Boards(), TrainingConfig(), tmp_path / "none")


def test_views_are_other_ones_in_each_step(tmp_path):
    training, _ = _train(tmp_path / "run", max_steps=1, augment=True)
    images = np.array([0, 3])
    first, again, other = (training._learner._views(images, step) for step in (0, 0, 1))
    assert torch.equal(first, again)
    assert not torch.equal(first[0], other[0])
