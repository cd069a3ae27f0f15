# SPDX-License-Identifier: Apache-2.0
import threading
import time

import pytest

from benchmarks import profile
from slam.stage_clock import StageClock


def busy(clock, stage, seconds):
    with clock.stage(stage):
        start_s = time.thread_time()
        while time.thread_time() - start_s < seconds:
            pass


def run_of_two_threads(_arguments):
    clock = StageClock()
    other = threading.Thread(target=busy, args=(clock, "describe", 0.02), name="loops_0")
    other.start()
    busy(clock, "track", 0.05)
    with clock.stage("track"):
        time.sleep(0.2)  # waiting is no work
    other.join()
    return 0


@pytest.fixture
def profiled(monkeypatch):
    monkeypatch.setattr(profile, "run_slam", run_of_two_threads)
    found = profile.Profile()
    assert found.run([]) == 0
    return found


def test_work_is_counted_where_it_is_done(profiled):
    assert set(profiled.seconds) == {("MainThread", "track"), ("loops", "describe")}
    assert 0.05 <= profiled.seconds["MainThread", "track"] < 0.2
    assert profiled.seconds["loops", "describe"] >= 0.02
    assert profiled.total_s >= sum(profiled.seconds.values())


def test_the_table_has_a_row_per_thread_and_stage_and_adds_up(profiled):
    rows = [line.strip("|").split("|") for line in profiled.table().splitlines()[2:]]
    assert [row[1].strip() for row in rows[:2]] == ["track", "describe"]
    seconds = [float(row[2]) for row in rows]
    assert sum(seconds[:-1]) == pytest.approx(seconds[-1], abs=0.02)


def test_without_a_sampler_it_says_what_to_install(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(profile.shutil, "which", lambda _: None)
    assert not profile.flame_graph([], tmp_path / "flame.svg")
    assert "pip install py-spy" in capsys.readouterr().err


def test_a_run_that_fails_ends_with_its_code(monkeypatch, tmp_path):
    monkeypatch.setattr(profile, "run_slam", lambda _: 2)
    assert profile.main(["nowhere", "--out", str(tmp_path)]) == 2
