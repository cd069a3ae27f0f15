# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from placerec.datasets import PlaceDataset
from placerec.errors import RecognizerError
from placerec.evaluation.figures import recognised_places
from placerec.evaluation.precision_recall import BestMatches

POSITIONS_M = np.array([[0.0, 5.0, 0.0], [1.0, 5.0, 2.0], [2.0, 5.1, 4.0], [0.0, 5.0, 0.1]])
MATCHES = BestMatches(
    queries=np.arange(4),
    references=np.array([3, 2, 0, 0]),
    similarities=np.array([0.9, 0.8, 0.3, 0.9], np.float32),
    are_right=np.array([True, False, False, True]),
)


@pytest.fixture
def dataset():
    same = np.ones((4, 4), dtype=bool)
    paths = tuple(Path(f"{i}.png") for i in range(4))
    everyone = np.arange(4)
    return PlaceDataset("walk", paths, everyone, everyone, same, same, positions_m=POSITIONS_M)


def segments(axes, label):
    (lines,) = [lines for lines in axes.collections if lines.get_label() == label]
    return np.array(lines.get_segments()).tolist()


def test_the_way_and_what_was_recognised_on_the_two_axes_of_most_extent(dataset):
    figure = recognised_places(dataset, MATCHES, 0.5, "ours")
    (axes,) = figure.axes
    assert (axes.get_title(), axes.get_xlabel(), axes.get_ylabel()) == ("ours", "x (m)", "z (m)")
    (way,) = axes.lines
    assert way.get_xydata().tolist() == POSITIONS_M[:, [0, 2]].tolist()
    assert segments(axes, "right (2)") == [[[0.0, 0.0], [0.0, 0.1]], [[0.0, 0.1], [0.0, 0.0]]]
    assert segments(axes, "wrong (1)") == [[[1.0, 2.0], [2.0, 4.0]]]
    shown = [text.get_text() for text in figure.legends[0].get_texts()]
    assert sorted(shown) == ["right (2)", "way", "wrong (1)"]


def test_nothing_recognised_leaves_the_way(dataset):
    (axes,) = recognised_places(dataset, MATCHES, 0.95).axes
    assert len(axes.lines) == 1
    assert len(axes.collections) == 0


def test_two_sessions_are_two_ways(dataset):
    sessions = replace(
        dataset,
        queries=np.array([0, 1]),
        references=np.array([2, 3]),
        same_place=np.ones((2, 2), bool),
        comparable=np.ones((2, 2), bool),
    )
    found = BestMatches(np.array([0]), np.array([1]), np.array([0.9], np.float32), np.array([True]))
    (axes,) = recognised_places(sessions, found, 0.5).axes
    assert [line.get_label() for line in axes.lines] == ["query", "reference"]
    assert segments(axes, "right (1)") == [[[0.0, 0.0], [0.0, 0.1]]]


def test_without_positions_there_is_nothing_to_draw(dataset):
    with pytest.raises(RecognizerError, match="walk does not say where"):
        recognised_places(replace(dataset, positions_m=None), MATCHES, 0.5)
