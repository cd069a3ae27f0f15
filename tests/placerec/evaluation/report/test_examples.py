# SPDX-License-Identifier: Apache-2.0
import base64
from dataclasses import replace

import cv2
import numpy as np
import pytest

from placerec.datasets import PlaceDataset
from placerec.evaluation.precision_recall import BestMatches
from placerec.evaluation.report.examples import first_matches, page_figure

COLOURS = ((250, 10, 10), (10, 250, 10), (10, 10, 250), (250, 250, 10))


@pytest.fixture
def dataset(tmp_path):
    """Return two queries and two references, each of one colour; the last is tall."""
    paths = tuple(tmp_path / f"{i}.png" for i in range(4))
    for path, colour in zip(paths, COLOURS, strict=True):
        size = (40, 10) if path.stem == "3" else (30, 40)
        cv2.imwrite(str(path), np.full((*size, 3), colour[::-1], np.uint8))
    truth = np.eye(2, dtype=bool)
    return PlaceDataset("walk", paths, np.arange(2), np.arange(2, 4), truth, np.ones_like(truth))


def matches(are_right):
    return BestMatches(
        np.arange(2), np.array([1, 0]), np.array([0.9, 0.8], np.float32), np.array(are_right)
    )


def decode(address, kind):
    start, content = address.split(",")
    assert start == f"data:{kind};base64"
    return base64.b64decode(content)


def test_query_stands_left_of_its_reference_each_in_its_own_shape(dataset):
    first, second = first_matches(dataset, matches([False, True]))
    assert (first.is_right, first.query, first.reference) == (True, "1.png", "2.png")
    assert (second.is_right, second.query, second.reference) == (False, "0.png", "3.png")
    assert second.similarity == pytest.approx(0.9)
    photograph = cv2.imdecode(np.frombuffer(decode(second.address, "image/jpeg"), np.uint8), 1)
    assert photograph.shape == (225, 606, 3)
    near = [(150, 112, COLOURS[0]), (456, 112, COLOURS[3]), (320, 112, (255, 255, 255))]
    for x, y, colour in near:
        assert np.abs(photograph[y, x, ::-1].astype(int) - colour).max() < 12


def test_of_several_right_ones_the_most_similar_is_shown(dataset):
    found = replace(matches([True, True]), similarities=np.array([0.7, 0.8], np.float32))
    right, _ = first_matches(dataset, found)
    assert (right.query, right.similarity) == ("1.png", pytest.approx(0.8))


def test_what_there_is_not_is_none(dataset):
    assert first_matches(dataset, matches([True, True]))[1] is None
    assert first_matches(dataset, matches([False, False]))[0] is None


def test_a_photograph_that_is_gone_leaves_its_names(dataset):
    dataset.paths[3].unlink()
    _, wrong = first_matches(dataset, matches([False, True]))
    assert (wrong.address, wrong.reference) == (None, "3.png")


def test_a_figure_is_a_file_within_the_page():
    found = page_figure(b"<svg/>", "nothing")
    assert decode(found.address, "image/svg+xml") == b"<svg/>"
    assert found.alt == "nothing"
