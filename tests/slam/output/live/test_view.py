# SPDX-License-Identifier: Apache-2.0
import json
import logging
import os
import signal
import subprocess
import sys
import time
from collections import defaultdict
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from placerec.recognizers.gradients import GradientRecognizer
from slam.__main__ import main
from slam.evaluation.trajectory import read_tum
from slam.output.live import view
from slam.output.live.view import LiveView
from slam.system import Slam
from slam.types import SlamError

ROOT = Path(__file__).parents[4]
QUICK = ("--map.write", "False", "--recognizer", "gradients")
needs_rerun = pytest.mark.skipif(
    find_spec("rerun") is None, reason="needs Rerun: pip install 'loopclose[live]'"
)


def read_back(path):
    """Return the rows of a recording by entity and component, in the order they were logged."""
    from rerun.chunk import RrdReader

    rows = defaultdict(list)
    for chunk in RrdReader(path).stream():
        batch = chunk.to_record_batch()
        for name in batch.schema.names:
            kept = [each for each in batch.column(name).to_pylist() if each is not None]
            rows[chunk.entity_path, name.split(":")[-1]] += kept
    return rows


@pytest.fixture
def short(frames):
    return frames[:6]


@pytest.fixture
def slam(sequence):
    return Slam(sequence.camera, GradientRecognizer())


def run(shown, slam, frames):
    with shown:
        for frame in frames:
            shown.add(frame, slam.process(frame))
        result = slam.finish()
        shown.finish(result)
    return result


def warnings(caplog):
    return [each.getMessage() for each in caplog.records if each.levelno >= logging.WARNING]


@pytest.fixture(scope="module")
def kept(recording, tmp_path_factory):
    """Return the folders of the same run without anything shown, and with a file for the viewer."""
    pytest.importorskip("rerun", reason="needs Rerun: pip install 'loopclose[live]'")
    folder = tmp_path_factory.mktemp("kept")
    assert main([str(recording), "--out", str(folder / "without"), *QUICK]) == 0
    flags = ("--rrd", str(folder / "with" / "run.rrd"))
    assert main([str(recording), "--out", str(folder / "with"), *QUICK, *flags]) == 0
    return folder


def test_the_outputs_are_the_same_bytes_with_and_without(kept):
    for name in ("trajectory.txt", "odometry.txt", "loops.jsonl", "pose_graph.g2o"):
        with_, without = ((kept / each / name).read_bytes() for each in ("with", "without"))
        assert with_ == without, name


def test_the_end_is_what_the_run_found_out(kept):
    rows = read_back(kept / "with" / "run.rrd")
    summary = json.loads((kept / "with" / "summary.json").read_text())
    (path,) = rows["/world/trajectory", "strips"][-1]
    written = read_tum(kept / "with" / "trajectory.txt").T_world_cam[:, :3, 3]
    assert len(path) == summary["frames_tracked"] == 60
    np.testing.assert_allclose(path, written, atol=1e-5)
    odometry = read_tum(kept / "with" / "odometry.txt").T_world_cam[:, :3, 3]
    np.testing.assert_allclose(rows["/world/odometry", "strips"][-1][0], odometry, atol=1e-5)
    accepted, rejected = (
        len(rows[f"/world/loops/{each}", "strips"][-1]) for each in ("accepted", "rejected")
    )
    assert accepted == summary["loops_accepted"] > 0
    assert accepted + rejected == summary["loops_verified"]
    assert len(rows["/world/keyframes", "positions"][-1]) == summary["keyframes"]
    assert rows["/log", "text"][-1] == [f"60 frames placed, {accepted} loops in use"]


def test_each_frame_and_each_candidate_is_shown_as_it_comes(kept):
    rows = read_back(kept / "with" / "run.rrd")
    summary = json.loads((kept / "with" / "summary.json").read_text())
    assert len(rows["/world/camera/colour", "blob"]) == 60
    assert len(rows["/world/camera/depth", "buffer"]) == 60
    assert len(rows["/world/camera", "translation"]) == 60
    assert sorted(rows["/world/camera", "frame"]) == list(range(60))
    seconds = np.array([each.total_seconds() for each in rows["/world/camera", "time"]])
    np.testing.assert_allclose(np.sort(seconds), np.arange(60) / 7.5, atol=1e-5)
    for name in ("covered_percent", "tracking_ms", "shift_mm"):
        assert len(rows[f"/plots/{name}", "scalars"]) == 60
    told = [text for (text,) in rows["/log", "text"] if " sees " in text]
    assert sum(not text.startswith("in the end") for text in told) <= summary["loops_tried"]
    assert any(": yes, " in text for text in told)
    assert len(rows["/matches", "blob"]) == len(rows["/matches/pairs", "strips"]) > 0
    assert len(rows["/world/map", "positions"][-1]) > 1000


@needs_rerun
def test_poses_from_elsewhere_are_shown_too(short_recording, tmp_path):
    folder = short_recording(12)
    typed = [str(folder), "--odometry", str(folder / "groundtruth.txt"), *QUICK]
    assert main([*typed, "--out", str(tmp_path / "out"), "--rrd", str(tmp_path / "a.rrd")]) == 0
    (path,) = read_back(tmp_path / "a.rrd")["/world/trajectory", "strips"][-1]
    written = read_tum(tmp_path / "out" / "trajectory.txt").T_world_cam[:, :3, 3]
    np.testing.assert_allclose(path, written, atol=1e-5)


def test_a_run_that_is_not_shown_loads_nothing(short_recording):
    script = (
        "import sys\n"
        "from slam.__main__ import main\n"
        "assert main(sys.argv[1:]) == 0\n"
        "assert not {'rerun', 'pyarrow', 'slam.output.live.scene'} & sys.modules.keys()\n"
    )
    folder = short_recording(3)
    command = [sys.executable, "-c", script, str(folder), "--out", str(folder / "out"), *QUICK]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def refused(typed, capsys):
    assert main(typed) == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line


def test_without_rerun_one_line_says_what_to_install(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(view, "find_spec", lambda name: None)
    line = refused(["demo", "--live", "--out", str(tmp_path / "out")], capsys)
    assert line.endswith("not installed: pip install 'loopclose[live]'")
    assert not (tmp_path / "out").exists()


@needs_rerun
def test_a_file_that_no_viewer_would_open_is_refused(capsys, tmp_path):
    line = refused(["demo", "--rrd", "run.bag", "--out", str(tmp_path / "out")], capsys)
    assert "ends in .rrd" in line


@needs_rerun
def test_a_folder_for_a_file_is_refused_at_once(tmp_path, capsys):
    (tmp_path / "a.rrd").mkdir()
    line = refused(["demo", "--rrd", str(tmp_path / "a.rrd"), "--out", str(tmp_path / "o")], capsys)
    assert "this is a folder" in line


@needs_rerun
def test_what_a_killed_run_left_is_there_still_if_the_file_cannot_be_kept(
    recording, tmp_path, capsys
):
    (tmp_path / "file").touch()
    left = tmp_path / "out" / "unfinished"
    left.mkdir(parents=True)
    (left / "journal.jsonl").write_text("mine")
    typed = [str(recording), "--rrd", str(tmp_path / "file" / "a.rrd"), *QUICK]
    assert main([*typed, "--out", str(tmp_path / "out")]) == 2
    assert "cannot write what --rrd keeps" in capsys.readouterr().err
    assert (left / "journal.jsonl").read_text() == "mine"


@needs_rerun
def test_a_file_where_none_can_be_is_refused(slam, sequence, tmp_path):
    (tmp_path / "file").touch()
    shown = LiveView(slam, sequence.camera, viewer=False, rrd=tmp_path / "file" / "a.rrd")
    with pytest.raises(SlamError, match="cannot write what --rrd keeps"), shown:
        pass


@needs_rerun
def test_a_killed_run_leaves_what_it_had_under_another_name(slam, sequence, short, tmp_path):
    shown = LiveView(slam, sequence.camera, viewer=False, rrd=tmp_path / "a.rrd")
    with shown:
        shown.add(short[0], slam.process(short[0]))
        assert [each.name for each in tmp_path.iterdir()] == ["a.unfinished.rrd"]
        assert (tmp_path / "a.unfinished.rrd").stat().st_size > 1000
    assert [each.name for each in tmp_path.iterdir()] == ["a.rrd"]


@needs_rerun
def test_a_full_disk_is_one_warning_and_the_run_goes_on(short_recording):
    script = (
        "import resource, sys\n"
        "from slam.__main__ import main\n"
        "from slam.output.live import view\n"
        "from slam.output.live.outlets import File\n"
        "view._EVERY_S = 0.0\n"
        "begin = File.__init__\n"
        "def fills_up(self, path):\n"
        "    begin(self, path)\n"
        "    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, -1))\n"
        "def again(self, abandon=File.abandon):\n"
        "    abandon(self)\n"
        "    resource.setrlimit(resource.RLIMIT_FSIZE, (-1, -1))\n"
        "File.__init__, File.abandon = fills_up, again\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    folder = short_recording(30)
    flags = ("--out", str(folder / "out"), "--rrd", str(folder / "a.rrd"), *QUICK)
    done = subprocess.run(
        [sys.executable, "-c", script, str(folder), *flags],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "Traceback" not in done.stderr
    said = [line for line in done.stderr.splitlines() if "the run goes on without" in line]
    assert len(said) == 1 and "a.rrd" in said[0]
    assert (folder / "out" / "report.html").exists()
    assert not list(folder.glob("a*.rrd"))


# Stand-ins for the viewer


@pytest.fixture
def viewer(monkeypatch, tmp_path):
    """Return a maker of what reads the pipe instead of a window."""
    outlets = pytest.importorskip("slam.output.live.outlets", reason="needs Rerun")
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setattr(outlets, "_PATIENCE_S", 0.2)

    def stand_in(code):
        code = f"import os, sys, time; open('pid', 'w').write(str(os.getpid())); {code}"
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(outlets, "_VIEWER", (sys.executable, "-c", code))

    return stand_in


def test_a_viewer_gets_all_of_it(viewer, slam, sequence, short, tmp_path, caplog, monkeypatch):
    monkeypatch.setattr(view, "_EVERY_S", 1e9)  # in one go, which can be read back as a file
    viewer("open('part', 'wb').write(sys.stdin.buffer.read()); os.rename('part', 'got.rrd')")
    run(LiveView(slam, sequence.camera), slam, short)
    while not (tmp_path / "got.rrd").exists():
        time.sleep(0.01)
    assert len(read_back(tmp_path / "got.rrd")["/world/camera/colour", "blob"]) == len(short)
    assert warnings(caplog) == []


@pytest.mark.parametrize(
    ("code", "why"),
    [
        ("pass", "closed"),
        ("sys.stdin.buffer.read(1000)", "closed"),
        ("time.sleep(60)", "does not answer"),
    ],
)
def test_a_viewer_that_ends_or_hangs_is_one_warning(
    viewer, slam, sequence, frames, tmp_path, caplog, monkeypatch, code, why
):
    monkeypatch.setattr(view, "_EVERY_S", 0.0)
    viewer(code)
    shown = LiveView(slam, sequence.camera, rrd=tmp_path / "a.rrd")
    result = run(shown, slam, frames[:20])
    os.kill(int((tmp_path / "pid").read_text()), signal.SIGKILL)
    (warning,) = warnings(caplog)
    assert warning.startswith("the run goes on without the live view: ") and why in warning
    (path,) = read_back(tmp_path / "a.rrd")["/world/trajectory", "strips"][-1]
    assert len(path) == len(result.trajectory)  # the file is whole


@needs_rerun
@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere there is always a display")
def test_without_a_display_it_is_one_warning(slam, sequence, short, monkeypatch, caplog):
    monkeypatch.delenv("DISPLAY", raising=False)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    assert len(run(LiveView(slam, sequence.camera), slam, short).trajectory) == len(short)
    (warning,) = warnings(caplog)
    assert "no display; keep the run with --rrd FILE" in warning


@needs_rerun
def test_what_cannot_be_drawn_is_one_warning(slam, sequence, short, tmp_path, monkeypatch, caplog):
    from slam.output.live.scene import Scene

    monkeypatch.setattr(Scene, "add", lambda *_: 1 / 0)
    run(LiveView(slam, sequence.camera, viewer=False, rrd=tmp_path / "a.rrd"), slam, short)
    (warning,) = warnings(caplog)
    assert "ZeroDivisionError" in warning and not list(tmp_path.iterdir())
