# SPDX-License-Identifier: Apache-2.0
import threading
import time

import pytest

from benchmarks import profile
from slam.loops.stage_clock import StageClock


def busy(clock, stage, seconds):
    with clock.stage(stage):
        start_s = time.thread_time()
        while time.thread_time() - start_s < seconds:
            pass


def run_of_two_threads(_arguments):
    clock = StageClock()
    other = threading.Thread(target=busy, args=(clock, "describe", 0.02), name="loops_0")
    other.start()
    busy(clock, "track", 0.1)
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
    own = {("MainThread", stage) for stage in ("start-up", "track", "outputs")}
    assert set(profiled.stages) == {*own, ("loops", "describe")}
    assert 0.1 <= profiled.stages["MainThread", "track"] < 0.2
    assert profiled.stages["loops", "describe"] >= 0.02
    assert profiled.total_s >= sum(profiled.stages.values()) - 0.01
    assert profiled.threads["MainThread"] > 0.035  # the system counts in ticks of 0.01, not all


def test_the_tables_have_a_row_per_stage_and_per_thread(profiled):
    stages, threads, _ = f"{profiled.table()}\n".split("\n\n")
    rows = [line.strip("|").split("|") for line in stages.splitlines()[2:]]
    assert [row[0].strip() for row in rows[:2]] == ["MainThread: track", "loops: describe"]
    assert float(rows[-1][1]) == pytest.approx(profiled.total_s, abs=0.01)
    assert "| MainThread | " in threads


def test_without_a_sampler_it_says_what_to_install(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(profile.shutil, "which", lambda _: None)
    assert not profile.flame_graph([], tmp_path / "flame.svg")
    assert "pip install py-spy" in capsys.readouterr().err


def test_a_run_that_fails_ends_with_its_code(monkeypatch, tmp_path):
    monkeypatch.setattr(profile, "run_slam", lambda _: 2)
    assert profile.main(["nowhere", "--out", str(tmp_path)]) == 2
