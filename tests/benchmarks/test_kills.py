# SPDX-License-Identifier: Apache-2.0
import pytest

from benchmarks.kills import flaws, kill, table

pytestmark = pytest.mark.usefixtures("built_rooms")


def test_runs_that_are_killed_leave_whole_files_of_one_run(tmp_path):
    killed = kill(kills=1, seed=1, seconds=2.0, scratch=tmp_path)
    assert [each.wrong for each in killed] == [()]
    assert [each.sent for each in killed] == ["SIGKILL"]
    assert "| SIGKILL | writing | 1 |" in table(killed)


def test_torn_and_mixed_files_are_found(tmp_path):
    first, out = tmp_path / "first", tmp_path / "out"
    for folder in (first, out):
        folder.mkdir()
        (folder / "trajectory.txt").write_text("1.0 0 0 0 0 0 0 1\n")
    assert flaws(out, first) == []
    (out / "summary.json").write_text("{")
    assert flaws(out, first) == [
        "summary.json is torn",
        "trajectory.txt of one run, summary.json of another",
    ]
