# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import torch

from placerec.checked_recognizer import COSINES, flaw_in


def test_cosines_agree_with_double_precision_and_never_pass_one():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(40, 300))
    rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    found = COSINES.compare(rows[:7], rows)
    assert found.shape == (7, 40)
    assert found.dtype == np.float32
    assert np.allclose(found, rows[:7].astype(float) @ rows.T.astype(float), atol=1e-6)
    assert found.max() <= 1.0


@pytest.mark.parametrize("size", [3, 513, 20_001])
def test_equal_pairs_tie_wherever_they_stand(size):
    two = np.random.default_rng(size).normal(size=(2, size))
    two = (two / np.linalg.norm(two, axis=1, keepdims=True)).astype(np.float32)
    rows = two[np.arange(67) % 2]
    assert len(np.unique(COSINES.compare(rows[:5], rows[1:]))) <= 3


@pytest.mark.parametrize(
    ("answer", "flaw"),
    [
        (np.zeros((2, 3), np.float32), None),
        ([[1.0, -1.0, 0], [1.0005, 0, 0]], None),
        (np.zeros((3, 2)), "similarities of shape (3, 2), not (queries, references) = (2, 3)"),
        (np.zeros(6), "similarities of shape (6,)"),
        (0.5, "similarities of shape ()"),
        ([[0, np.nan, 0], [np.inf, 0, 0]], "2 of 6 similarities that are NaN or infinite"),
        ([[0, 0, 0], [0, -3.5, 1]], "a similarity of -3.5; it must lie from -1 to 1"),
        (None, "a NoneType that is not an array of numbers|shape ()"),
        ({"a": 1}, "a dict that is not an array of numbers"),
        ([[1, 2], [3]], "a list that is not an array of numbers"),
        (torch.zeros(2, 3, requires_grad=True), "a Tensor that is not an array of numbers"),
    ],
)
def test_what_is_wrong_with_an_answer_is_said(answer, flaw):
    found = flaw_in(answer, (2, 3))
    if flaw is None:
        assert found is None
    else:
        assert any(part in found for part in flaw.split("|"))


def test_there_is_nothing_wrong_with_no_similarities():
    assert flaw_in(np.empty((0, 3), np.float32), (0, 3)) is None
