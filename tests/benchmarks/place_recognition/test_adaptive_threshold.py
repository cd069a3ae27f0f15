# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.place_recognition import adaptive_threshold
from placerec.datasets import open_dataset


@pytest.fixture
def drives(tmp_path):
    """Return two drives along eight stripes, three images of each."""
    rng = np.random.default_rng(0)
    stripes = [rng.integers(0, 255, (48, 64, 3), np.uint8) for _ in range(8)]
    for name in ("may", "june"):
        (tmp_path / name).mkdir()
        for i in range(24):
            noise = rng.integers(-20, 20, (48, 64, 3))
            image = np.clip(stripes[i // 3] + noise, 0, 255).astype(np.uint8)
            cv2.imwrite(str(tmp_path / name / f"{i:04d}.png"), image)
    return f"{tmp_path / 'may'}+{tmp_path / 'june'}:1"


def test_a_line_for_each_threshold_with_intervals(drives, monkeypatch, capsys):
    arguments = ["", drives, "--recognizer", "gradients", "--resamples", "5"]
    monkeypatch.setattr(sys, "argv", arguments)
    assert adaptive_threshold.main() == 0
    _, _, *lines = capsys.readouterr().out.splitlines()
    kinds = [line.split(" | ")[1] for line in lines]
    assert kinds[:3] == ["calibrated", "adaptive", "oracle"]
    assert "90 pairs of one place" in kinds[3]  # 23 + 22 neighbours in each drive
    oracle_cut = float(lines[2].split(" | ")[3].split("%")[0])
    assert oracle_cut <= 6.0
    assert all(line.count("% to ") == 2 for line in lines[:3])


def test_what_is_no_data_ends_in_one_line(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["", str(Path("nowhere"))])
    assert adaptive_threshold.main() == 2
    assert capsys.readouterr().err.startswith("error: there is no such folder")


def test_of_a_recording_the_way_within_three_seconds_is_known(recording):
    dataset = open_dataset(str(recording))
    known, order = adaptive_threshold.distances_known(dataset)
    assert order.tolist() == list(range(len(dataset)))
    is_soon = np.abs(np.subtract.outer(dataset.timestamps_s, dataset.timestamps_s)) <= 3.0
    assert (np.isfinite(known) == is_soon).all() and not is_soon.all()
    assert ((known < 1.0) == dataset.same_place)[is_soon].all()
    lines = adaptive_threshold.table(str(recording), "gradients", resamples=5)
    assert [line.split(" | ")[1] for line in lines[:3]] == ["calibrated", "adaptive", "oracle"]
