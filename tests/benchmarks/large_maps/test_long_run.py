# SPDX-License-Identifier: Apache-2.0
import json
from dataclasses import replace

import numpy as np
import pytest

from benchmarks.large_maps import long_run
from slam.demo.panels import Panel
from slam.geometry import se3


@pytest.fixture(scope="module")
def benchmark():
    return long_run


@pytest.fixture
def run(benchmark):
    def make(frames: int, late_s: float = 0.01):
        frame_s = np.where(np.arange(frames) < 2000, 0.01, late_s)
        frame_s[700] = 0.25
        return benchmark.Run(
            frame_s=frame_s,
            cpu_s=2.0 * frame_s,
            anew_s=np.full(1000, 0.008),
            memory_mb=0.1 * np.arange(frames),
            keyframes=np.arange(frames) // 10 + 1,
            query_s=np.full(frames // 10, 5e-4),
            finish_s=12.34,
            peak_memory_mb=999.0,
            untracked=3,
            loops=40,
            false_loops=1,
            ate_m=(0.1, 0.01),
        )

    return make


def rows(text: str) -> dict[str, list[str]]:
    lines = [line for line in text.splitlines() if line.startswith("|")]
    cells = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines]
    return {first: rest for first, *rest in cells}


def test_a_lap_is_closed_and_smooth(benchmark):
    T_world_cam = benchmark.lap(np.arange(181) / 180)
    np.testing.assert_allclose(T_world_cam[180], T_world_cam[0], atol=1e-12)
    R = T_world_cam[:, :3, :3]
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(3), (181, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(R), 1.0)
    step = se3.inverse(T_world_cam[:-1]) @ T_world_cam[1:]
    assert se3.translation_norm(step).max() < 0.04
    assert np.degrees(se3.rotation_angle(step)).max() < 3.0


def test_growth_is_between_frame_1000_and_the_last_1000(run):
    assert run(5000).growth(run(5000).frame_s, np.median) == pytest.approx(1.0)
    slower = run(5000, late_s=0.03)
    assert slower.growth(slower.frame_s, np.median) == pytest.approx(3.0)


def test_the_table_has_a_column_per_run(benchmark, run):
    found = rows(benchmark.table([run(3000), run(6000, late_s=0.02)]))
    assert found["frames"] == ["3000", "6000"]
    assert found["keyframes"] == ["300", "600"]
    assert found["ms per frame around frame 1,000"] == ["10.00", "10.00"]
    assert found["their ratio"] == ["1.00", "2.00"]
    assert found["ms for the same frames early in a run"] == ["8.00", "8.00"]
    assert found["their ratio to these"] == ["1.25", "2.50"]
    assert found["longest frame, ms"] == ["250", "250"]
    assert found["kB per keyframe, second half"] == ["1024", "1024"]
    assert found["ms per loop query at the end"] == ["0.50", "0.50"]
    assert found["loops kept"] == ["40, 1 of them false"] * 2
    assert found["ATE, m: odometry → corrected"] == ["0.1000 → 0.0100"] * 2


def test_too_short_a_run_is_refused(benchmark, tmp_path, capsys):
    with pytest.raises(SystemExit):
        benchmark.main(["--frames", "500", "--out", str(tmp_path)])
    assert "--frames 500: more than 500 are needed" in capsys.readouterr().err


def test_exponents_are_of_the_number_of_frames(benchmark, run):
    runs = [run(3000), run(6000, late_s=0.02)]
    found = benchmark.exponents(runs)
    assert found["ms per frame at the end"] == pytest.approx(1.0)
    assert found["seconds for finishing"] == pytest.approx(0.0)
    read = json.loads(benchmark.as_json(runs, width=320))
    assert read["width"] == 320 and read["exponents"] == found
    assert [each["frames"] for each in read["runs"]] == [3000, 6000]
    assert read["runs"][1]["ratio to frame 1,000"] == pytest.approx(2.0)
    assert read["runs"][1]["ratio to the same frames early in a run"] == pytest.approx(2.5)
    assert json.loads(benchmark.as_json(runs[:1]))["exponents"] == {}


def test_a_walk_leads_from_a_lap_to_one_in_the_next_room(benchmark):
    T_world_cam = benchmark.walk(np.arange(151) / 150)
    (T_lap,) = benchmark.lap(np.zeros(1))
    np.testing.assert_allclose(T_world_cam[0], T_lap, atol=1e-12)
    T_next = T_lap.copy()
    T_next[0, 3] += benchmark.ROOM_SIZE_M[0]
    np.testing.assert_allclose(T_world_cam[150], T_next, atol=1e-12)
    step = se3.inverse(T_world_cam[:-1]) @ T_world_cam[1:]
    assert se3.translation_norm(step).max() < 0.07
    assert np.degrees(se3.rotation_angle(step)).max() < 3.0


def test_doors_are_open_and_the_other_walls_are_not(benchmark):
    width_m, depth_m, height_m = benchmark.ROOM_SIZE_M
    texture = np.zeros((26, 40, 3), np.uint8)
    up = np.array([0.0, 0.0, -height_m])
    wall = Panel(
        np.array([width_m / 2, depth_m / 2, height_m]), np.array([0.0, -depth_m, 0.0]), up, texture
    )
    beside = Panel(
        np.array([-width_m / 2, -depth_m / 2, height_m]), np.array([width_m, 0, 0]), up, texture
    )
    shelf = replace(wall, corner_m=np.array([2.2, 0.3, 1.0]), right_m=np.array([0.0, -0.6, 0.0]))
    left, right, untouched = benchmark.cut_doors([wall, shelf, beside])
    assert untouched is beside
    np.testing.assert_allclose(left.corner_m, wall.corner_m)
    np.testing.assert_allclose((left.corner_m + left.right_m)[1], 0.6)
    np.testing.assert_allclose(right.corner_m[1], -0.6)
    np.testing.assert_allclose((right.corner_m + right.right_m)[1], -depth_m / 2)
    assert left.texture.shape == (26, 14, 3)


def test_a_film_goes_on_in_the_next_room(benchmark, monkeypatch):
    rendered = []

    def photographed(film, number):
        rendered.append(number)
        shade = np.full((3, 4), 10.0 * number + 10.0, np.float32)
        return [(np.full((3, 4, 3), shot % 256, np.uint8), shade) for shot in range(330)]

    monkeypatch.setattr(benchmark.Film, "_photographed", photographed)
    film = benchmark.Film(width=4, laps=2)
    lap, walk = benchmark.LAP, benchmark.WALK
    shown = [film.frame(i) for i in (0, lap, 2 * lap, 2 * lap + walk)]
    assert [round(float(each.depth_m.mean())) for each in shown] == [10, 10, 10, 20]
    assert rendered == [0, 1]
    x = film.truth(2 * lap + walk + 1).T_world_cam[:, 0, 3]
    assert x[lap] == pytest.approx(x[0])
    assert x[-1] == pytest.approx(x[0] + benchmark.ROOM_SIZE_M[0])
    assert np.abs(np.diff(x)).max() < 0.07
    alone = benchmark.Film(width=4).truth(3 * lap).T_world_cam[:, 0, 3]
    assert alone[2 * lap] == pytest.approx(alone[0])


def test_laps_are_run_measured_and_drawn(benchmark, tmp_path, monkeypatch):
    monkeypatch.setattr(benchmark, "EARLY", slice(20, 40))
    run = benchmark.measure(60, "gradients", width=160)
    assert run.untracked == run.false_loops == 0
    assert (np.diff(run.keyframes) >= 0).all() and 5 < run.keyframes[-1] < 30
    assert run.keyframes[-1] <= len(run.query_s) <= 2 * run.keyframes[-1]
    assert min(run.frame_s.min(), run.cpu_s.sum(), run.finish_s) > 0.0
    assert max(run.ate_m) < 0.05
    assert run.peak_memory_mb >= run.memory_mb[-1]
    assert rows(benchmark.table([run]))["frames"] == ["60"]
    benchmark.draw([run], tmp_path)
    assert "<svg" in (tmp_path / "long_run.svg").read_text()
    assert (tmp_path / "long_run.png").read_bytes().startswith(b"\x89PNG")
