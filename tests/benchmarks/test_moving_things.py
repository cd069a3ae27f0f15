# SPDX-License-Identifier: Apache-2.0
import sys

from benchmarks import moving_things


def test_a_board_that_is_followed_is_warned_of_and_none_is_not(recording, monkeypatch, capsys):
    boards = ((0.0, 0.0, 0, 0), (0.25, 1.0, 8, 0), (0.25, 1.0, 8, 25))
    monkeypatch.setattr(moving_things, "_BOARDS", boards)
    monkeypatch.setattr(sys, "argv", ["", str(recording), "--frames", "50"])
    moving_things.main()
    _, _, plain, *others = capsys.readouterr().out.splitlines()
    *_, ate, warned = plain.strip("| ").split(" | ")
    assert warned == "no" and float(ate.split()[0]) < 0.02
    assert others[0].endswith(" yes |")
    for first, board in zip((0, 25), others, strict=True):
        assert board.startswith(f"| 25% | 8 | {first} |")
