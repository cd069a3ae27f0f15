# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from pathlib import Path

import pytest

from benchmarks.place_recognition.__main__ import main
from benchmarks.place_recognition.trainings import (
    LOSSES,
    PAPERS,
    SEEDS,
    TRUNK_PLANS,
    compared_name,
    planned_trainings,
)
from placerec.networks import TRUNKS

PLANNED = {each.name: each for each in planned_trainings()}


def test_every_training_has_a_name_and_a_folder_of_its_own():
    assert len(PLANNED) == len(planned_trainings())
    assert len({each.folder(Path()) for each in PLANNED.values()}) == len(PLANNED)


@pytest.mark.parametrize("trunk", TRUNKS)
@pytest.mark.parametrize("seed", SEEDS)
def test_compared_trainings_differ_in_the_loss_alone(trunk: str, seed: int):
    ours, theirs = (PLANNED[compared_name(trunk, loss, seed)].plan for loss in LOSSES)
    assert replace(ours, loss="triplet") == theirs != ours
    assert (ours.trunk, ours.seed) == (trunk, seed)


@pytest.mark.parametrize("seed", SEEDS)
def test_papers_conditions_are_the_same_for_both_losses(seed: int):
    ours, theirs = (PLANNED[compared_name(PAPERS, loss, seed)].plan for loss in LOSSES)
    assert replace(ours, loss="triplet") == theirs != ours
    assert (ours.alpha, ours.beta, ours.gamma_prime) == (0.5, 0.3, 0.4)
    assert ours.random_last_layer and not ours.covariance


@pytest.mark.parametrize("trunk", TRUNKS)
def test_cut_trunks_can_be_built(trunk: str):
    block = TRUNK_PLANS[trunk].block
    assert block is None or TRUNKS[trunk].layer_count(block)


def test_another_plan_of_the_same_name_is_not_taken_for_done(tmp_path: Path):
    first = planned_trainings()[0]
    first.folder(tmp_path).mkdir()
    first.weights(tmp_path).touch()
    other = replace(first, plan=replace(first.plan, steps=7))
    assert first.weights(tmp_path).exists()
    assert not other.weights(tmp_path).exists()


@pytest.mark.parametrize("parts", [1, 2, 3])
def test_parts_share_all_trainings_among_them(parts: int, monkeypatch, capsys):
    folders = [f"--{name}=nowhere" for name in ("data", "scenes", "validation", "trunk-weights")]
    for part in range(1, parts + 1):
        told = ["_", *folders, "--runs=nowhere", "--list", f"--part={part}/{parts}"]
        monkeypatch.setattr("sys.argv", told)
        main()
    listed = [line.removeprefix("to do  ") for line in capsys.readouterr().out.splitlines()]
    assert sorted(listed) == sorted(each.folder(Path()).name for each in PLANNED.values())
