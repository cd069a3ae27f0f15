# SPDX-License-Identifier: Apache-2.0
import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slam import Config, open_sequence
from slam.types import Camera

pytestmark = pytest.mark.usefixtures("built_rooms")

BENCHMARK = Path(__file__).parents[2] / "benchmarks" / "sweeps.py"
TINY = Camera(160, 120, 131.25, 131.25, 79.5, 59.5)


@pytest.fixture(scope="module")
def benchmark():
    spec = importlib.util.spec_from_file_location("benchmark_of_sweeps", BENCHMARK)
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # where dataclasses look their module up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return tmp_path_factory.mktemp("data")


@pytest.fixture(scope="module")
def tiny(benchmark, data):
    return benchmark.rendered(benchmark.Rendering("tiny", TINY), 0.4, data)


def test_another_world_and_another_clock_show_the_same_pixels(benchmark, tiny, tmp_path):
    sweep = benchmark.Sweep(world=4.0, clock=2.0)
    folders = (tiny, benchmark.derived(tiny, sweep, tmp_path / "derived"))
    usual, other = (open_sequence(folder, Config().input) for folder in folders)
    assert len(list(usual)) == len(list(other)) == 6
    for here, there in zip(usual, other, strict=True):
        np.testing.assert_array_equal(there.rgb, here.rgb)
        np.testing.assert_allclose(there.depth_m, 4.0 * here.depth_m, rtol=1e-6)
        assert there.timestamp_s == pytest.approx(here.timestamp_s / 2.0, abs=1e-6)
    truth, moved = usual.ground_truth, other.ground_truth
    np.testing.assert_allclose(moved.timestamps_s, truth.timestamps_s / 2.0, atol=1e-6)
    np.testing.assert_allclose(moved.T_world_cam[:, :3, 3], 4.0 * truth.T_world_cam[:, :3, 3])
    np.testing.assert_allclose(moved.T_world_cam[:, :3, :3], truth.T_world_cam[:, :3, :3])
    assert other.camera == replace(usual.camera, depth_scale=usual.camera.depth_scale / 4.0)


def test_a_rendering_is_kept_for_the_next_run(benchmark, tiny, data):
    before = (tiny / "rgb.txt").stat().st_mtime_ns
    assert benchmark.rendered(benchmark.Rendering("tiny", TINY), 0.4, data) == tiny
    assert (tiny / "rgb.txt").stat().st_mtime_ns == before
    longer = benchmark.rendered(benchmark.Rendering("tiny", TINY), 0.5, data)
    assert longer != tiny and len((longer / "rgb.txt").read_text().splitlines()) == 9


def test_every_row_names_its_frames_and_its_errors_by_the_size_of_its_world(
    benchmark, tiny, data, tmp_path, monkeypatch, capsys
):
    rendering, page = benchmark.Rendering("tiny", TINY), tmp_path / "table.md"
    sweeps = {
        "tiny": benchmark.Sweep(rendering),
        "tiny-x4": benchmark.Sweep(rendering, world=4.0),
        "untouched": benchmark.Sweep(benchmark.Rendering("untouched", TINY)),
    }
    monkeypatch.setattr(benchmark, "SWEEPS", sweeps)
    options = ["--recognizer", "gradients", "--seconds", "0.4", "--data", str(data)]
    options += ["--out", str(page)]
    assert benchmark.main(["--only", "tiny", "tiny-x4", *options]) == 0
    assert page.read_text() == capsys.readouterr().out
    assert not (data / "untouched-0.4s").exists()
    lines = [line for line in page.read_text().splitlines() if line.startswith("|")]
    titles, _, *found = ([cell.strip() for cell in line.split("|")[1:-1]] for line in lines)
    assert [row[0] for row in found] == ["tiny", "tiny-x4"]
    for row, size in zip(found, (1.0, 4.0), strict=True):
        cells = dict(zip(titles, row, strict=True))
        assert cells["frames tracked"] == "6 of 6" and cells["segments"] == "1"
        *_, corrected_m = cells["ATE in the end, m: without loops → with"].split(" → ")
        by_size = pytest.approx(float(corrected_m) / size, abs=1e-4)
        assert float(cells["the last / size, m"]) == by_size
        assert len(cells["ATE live, m: odometry → corrected"].split(" → ")) == 2


def test_the_sweeps_are_of_all_that_was_promised(benchmark):
    sweeps = benchmark.SWEEPS
    assert {sweep.world for sweep in sweeps.values()} == {0.5, 1.0, 4.0}
    assert {sweep.clock for sweep in sweeps.values()} == {1.0, 2.0, 4.0}
    renderings = {sweep.rendering for sweep in sweeps.values()}
    assert {each.frames_per_s for each in renderings} == {10.0, 15.0, 60.0}
    assert {each.camera.width for each in renderings} == {320, 640, 1280}
    assert {each.enlarged for each in renderings} == {1.0, 3.0, 4.0}
    assert all(each.camera.readout_s == 0.0 for each in renderings)
    names = [each.name for each in renderings]
    assert len(set(names)) == len(names)


def test_an_unknown_row_is_refused(benchmark, capsys):
    with pytest.raises(SystemExit):
        benchmark.main(["--only", "moon"])
    assert "moon" in capsys.readouterr().err
