# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import pytest

from placerec.errors import RecognizerError
from placerec.training.log import StepRecord, TrainingLog, read_log

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
