# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import cv2
import numpy as np
import pytest

from placerec.errors import LoopcloseError, RecognizerError
from placerec.training.log import StepRecord, TrainingLog, read_log, write_plot

FIRST = StepRecord(1, 1, 0.123456, 0.8, 7, 1e-5, 33.25, 1.5, 20.0)
SECOND = replace(FIRST, step=2, loss=1e-7)


def test_reads_what_was_written(tmp_path):
    log = TrainingLog(tmp_path / "log.csv", 0)
    log.add(FIRST)
    log.add(SECOND)
    assert read_log(tmp_path / "log.csv") == [FIRST, SECOND]
    assert read_log(tmp_path / "none.csv") == []


def test_going_on_forgets_later_steps_and_half_a_line_and_keeps_the_bytes_before(tmp_path):
    path = tmp_path / "log.csv"
    log = TrainingLog(path, 0)
    log.add(FIRST)
    before = path.read_bytes()
    log.add(SECOND)
    TrainingLog(path, 1)
    assert path.read_bytes() == before
    with path.open("a") as file:
        file.write("2,1,0.5")
    assert read_log(path) == [FIRST]
    TrainingLog(path, 1).add(SECOND)
    assert read_log(path) == [FIRST, SECOND]


@pytest.mark.parametrize("content", [b"a,b\n1,2\n", b"\xff\xfe\n", None])
def test_file_of_something_else_is_refused_and_left_alone(tmp_path, content):
    path = tmp_path / "log.csv"
    TrainingLog(path, 0).add(FIRST)
    content = path.read_bytes() + b"2,one\n" if content is None else content
    path.write_bytes(content)
    with pytest.raises(RecognizerError, match=r"log.*log\.csv$") as caught:
        TrainingLog(path, 5)
    assert "\n" not in str(caught.value)
    assert path.read_bytes() == content


def _records(count, loss=0.5):
    return [
        StepRecord(step, 1, loss / step, 0.8, 0, 1e-4, 10.0, float(step), 0.0)
        for step in range(1, count + 1)
    ]


@pytest.mark.parametrize("count", [0, 1, 50])
def test_the_plot_is_a_picture_whatever_the_number_of_steps_and_the_same_again(tmp_path, count):
    write_plot(_records(count), tmp_path / "a.png")
    write_plot(_records(count), tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert min(cv2.imread(str(tmp_path / "a.png")).shape[:2]) > 300


def test_the_plot_shows_the_loss(tmp_path):
    write_plot(_records(20), tmp_path / "a.png")
    write_plot(_records(20)[:10] + _records(20, loss=0.9)[10:], tmp_path / "b.png")
    a, b = (cv2.imread(str(tmp_path / name)) for name in ("a.png", "b.png"))
    rows = np.flatnonzero((a != b).any(axis=(1, 2)))
    assert rows.size
    assert rows.max() < 0.55 * len(a)  # in the upper half, where it is drawn


def test_a_missing_folder_of_the_plot_is_one_line(tmp_path):
    with pytest.raises(LoopcloseError, match=r"^cannot write log\.png"):
        write_plot(_records(2), tmp_path / "none" / "log.png")
