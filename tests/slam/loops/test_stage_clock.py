# SPDX-License-Identifier: Apache-2.0
import pytest

from slam.loops import stage_clock
from slam.loops.stage_clock import StageClock


@pytest.fixture
def clock(monkeypatch):
    now_s = iter([0.0, 1.0, 10.0, 12.0, 20.0, 24.0, 30.0])
    monkeypatch.setattr(stage_clock.time, "perf_counter", lambda: next(now_s))
    return StageClock()


def test_seconds_add_up_per_stage_in_the_order_of_the_pipeline(clock):
    for name in ("track", "graph", "track"):
        with clock.stage(name):
            pass
    assert list(clock.seconds.items()) == [("track", 5.0), ("graph", 2.0)]


def test_time_passes_between_stages_and_only_once_where_they_overlap(clock):
    with clock.stage("track"), clock.stage("graph"):
        pass
    assert clock.seconds == {"graph": 9.0, "track": 12.0}
    assert clock.elapsed_s == 12.0


def test_what_was_compiled_since_the_first_stage_began_is_told(clock, monkeypatch):
    compiled_s = iter([0.5, 0.75, 2.5])
    monkeypatch.setattr(stage_clock, "compiling_s", lambda: next(compiled_s))
    for said_s in (0.25, 2.0):
        with clock.stage("track"):
            pass
        assert clock.compiling_s == said_s


def test_a_stage_that_fails_has_taken_its_time_too(clock):
    with pytest.raises(KeyboardInterrupt), clock.stage("track"):
        raise KeyboardInterrupt
    assert clock.seconds == {"track": 1.0}
