# SPDX-License-Identifier: Apache-2.0
import sys

import pytest

from benchmarks import moving_things


@pytest.mark.parametrize("first", [0, 25])
def test_a_board_that_is_followed_is_warned_of_and_none_is_not(
    recording, monkeypatch, capsys, first
):
    boards = ((0.0, 0.0, 0, 0), (0.25, 1.0, 8, first))
    monkeypatch.setattr(moving_things, "_BOARDS", boards)
    monkeypatch.setattr(sys, "argv", ["", str(recording), "--frames", "50"])
    moving_things.main()
    _, _, plain, board = capsys.readouterr().out.splitlines()
    *_, ate, warned = plain.strip("| ").split(" | ")
    assert warned == "no" and float(ate.split()[0]) < 0.02
    assert board.startswith(f"| 25% | 8 | {first} |")
