# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from benchmarks.place_recognition import place_index as benchmark


def test_every_size_has_a_column(capsys):
    assert benchmark.main(["--places", "3", "50", "--values", "16", "--queries", "4"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    assert cells[0] == ["places", "3", "50"]
    assert [row[0] for row in cells[2:]] == list(benchmark.TITLES[1:])
    assert all(float(cell) >= 0.0 for row in cells[2:] for cell in row[1:])


def test_every_other_query_is_a_place_seen_again():
    index, _ = benchmark.filled(30, 64)
    best = [index.query(query, 1)[1][0] for query in benchmark.asked(30, 64, 6)]
    assert min(best[::2]) > 0.8 > max(best[1::2])


def test_a_wrong_answer_ends_it(monkeypatch, capsys):
    answer = np.array([0]), np.array([1.0], np.float32)
    monkeypatch.setattr(benchmark.PlaceIndex, "query", lambda *asked: answer)
    assert benchmark.main(["--places", "5", "--values", "8", "--queries", "2"]) == 1
    assert "not that of the plain comparison" in capsys.readouterr().err


def test_nothing_to_measure_is_refused(capsys):
    with pytest.raises(SystemExit) as ended:
        benchmark.main(["--places", "0"])
    assert ended.value.code == 2 and "at least 1" in capsys.readouterr().err
