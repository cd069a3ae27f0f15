# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from placerec.datasets import PlaceDataset
from placerec.evaluation.figures import distance_map, heat_maps, png, truth_map


@pytest.fixture
def dataset():
    same = np.eye(3, 4, dtype=bool)
    comparable = np.ones_like(same)
    comparable[2, 0] = False
    paths = tuple(Path(f"{i}.png") for i in range(7))
    return PlaceDataset("walk", paths, np.arange(3), np.arange(3, 7), same, comparable)


@pytest.fixture
def similarities():
    return np.linspace(0.5, 1.0, 12, dtype=np.float32).reshape(3, 4)


def titles(figure):
    return [axes.get_title() for axes in figure.axes if axes.get_xlabel() == "reference"]


def test_truth_stands_beside_every_method(dataset, similarities):
    figure = heat_maps(dataset, {"one": similarities, "two": similarities}, columns=2)
    assert titles(figure) == ["ground truth", "one", "two"]
    maps = [axes for axes in figure.axes if axes.get_title()]
    assert [axes.get_ylabel() for axes in maps] == ["query"] * 3
    assert np.allclose(maps[1].images[0].get_array(), np.sqrt(2 - 2 * similarities), atol=1e-6)


def test_truth_has_three_kinds_of_pairs_or_two(dataset):
    (axes, bar) = truth_map(dataset).axes
    assert axes.images[0].get_array().tolist() == [[0, 1, 1, 1], [1, 0, 1, 1], [2, 1, 0, 1]]
    names = [label.get_text() for label in bar.get_xticklabels()]
    assert names == ["same place", "different", "not compared"]
    (_, bar) = truth_map(replace(dataset, comparable=np.ones((3, 4), bool))).axes
    assert [label.get_text() for label in bar.get_xticklabels()] == names[:2]


def test_colours_are_spent_on_the_pairs_that_count(dataset, similarities):
    similarities[2, 0] = -1.0
    (axes, bar) = distance_map("one", similarities, dataset).axes
    low, high = axes.images[0].get_clim()
    assert 0.0 <= low < high < 1.1
    assert bar.get_xlabel() == "distance"


def test_equal_distances_and_rounding_above_one_can_be_drawn(dataset):
    figure = distance_map("same", np.full((3, 4), 1.0000001, np.float32), dataset)
    assert (figure.axes[0].images[0].get_array() == 0.0).all()
    assert png(figure)


def test_a_large_matrix_is_thinned_out_but_keeps_its_numbering(dataset):
    same = np.eye(1001, 4, dtype=bool)
    long = replace(
        dataset,
        paths=(Path("x"),) * 1005,
        queries=np.arange(1001),
        references=np.arange(1001, 1005),
        same_place=same,
        comparable=np.ones_like(same),
    )
    (axes, _) = truth_map(long).axes
    assert axes.images[0].get_array().shape == (334, 4)
    assert axes.get_ylim() == (1000.5, -0.5)
