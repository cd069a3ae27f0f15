# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from placerec.errors import RecognizerError
from placerec.training.log import StepRecord, write_plot


def _records(count, loss=0.5):
    return [
        StepRecord(step, 1, loss / step, 0.8, 0, 1e-4, 10.0, float(step), 0.0)
        for step in range(1, count + 1)
    ]


@pytest.mark.parametrize("count", [0, 1, 50])
def test_is_a_picture_whatever_the_number_of_steps_and_the_same_again(tmp_path, count):
    write_plot(_records(count), tmp_path / "a.png")
    write_plot(_records(count), tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert min(cv2.imread(str(tmp_path / "a.png")).shape[:2]) > 300


def test_shows_the_loss(tmp_path):
    write_plot(_records(20), tmp_path / "a.png")
    write_plot(_records(20)[:10] + _records(20, loss=0.9)[10:], tmp_path / "b.png")
    a, b = (cv2.imread(str(tmp_path / name)) for name in ("a.png", "b.png"))
    rows = np.flatnonzero((a != b).any(axis=(1, 2)))
    assert rows.size
    assert rows.max() < 0.55 * len(a)  # in the upper half, where it is drawn


def test_missing_folder_is_one_line(tmp_path):
    with pytest.raises(RecognizerError, match=r"^cannot write log\.png"):
        write_plot(_records(2), tmp_path / "none" / "log.png")
