# SPDX-License-Identifier: Apache-2.0
import os
import re
import signal
import sys
from itertools import islice
from types import SimpleNamespace

import numpy as np
import pytest

from slam import Camera, Config, Frame, SlamError, open_sequence, read_tum

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5, depth_scale=1000.0)


class Clock:
    """Time that passes only where somebody sleeps or works."""

    def __init__(self):
        self.now = 1000.0

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds


@pytest.fixture(scope="module")
def frames(recording):
    return list(islice(open_sequence(recording, Config().input), 12))


def filmed(example, work_s, fps=30.0, count=31):
    """Return which frames somebody gets who works so long on each, and when."""
    clock = Clock()
    seen = []
    for i in example.film(7.0 + np.arange(count) / fps, lambda i: i, clock):
        seen.append((i, clock.now - 1000.0))
        clock.now += work_s
    return seen


def test_a_camera_shows_each_frame_in_its_time_to_who_is_quick(example):
    seen = filmed(example, work_s=0.01)
    assert [i for i, _ in seen] == list(range(31))
    np.testing.assert_allclose([when for _, when in seen], np.arange(31) / 30.0)


def test_a_camera_does_not_wait_and_shows_the_newest(example):
    seen = filmed(example, work_s=0.1001)
    assert [i for i, _ in seen] == list(range(0, 31, 3))
    for i, when in seen:
        assert i / 30.0 <= when < (i + 1) / 30.0


def test_a_run_on_the_rendered_room_tells_what_happens_and_can_be_kept(example, tmp_path, capsys):
    kept, out = tmp_path / "kept", tmp_path / "out"
    example.main(["--seconds", "1", "--record", str(kept), "--out", str(out)], clock=Clock())
    told = capsys.readouterr().out
    assert "0.000 s  keyframe 0 at 0.00 0.00 0.00 m" in told
    assert "15 frames tracked" in told
    assert (out / "report.html").is_file()
    sequence = open_sequence(kept, Config().input)
    assert sequence.camera == example.ROOM_CAMERA
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(15) / 15.0, atol=1e-6)
    example.main([str(kept), "--out", str(tmp_path / "again")], clock=Clock())
    live, again = (read_tum(folder / "trajectory.txt") for folder in (out, tmp_path / "again"))
    np.testing.assert_allclose(again.T_world_cam, live.T_world_cam, atol=0.003)


def test_what_is_kept_is_what_was_filmed(example, frames, tmp_path):
    passed_on = list(example.recorded(frames, CAMERA, tmp_path / "kept"))
    assert [frame is mine for frame, mine in zip(passed_on, frames, strict=True)] == [True] * 12
    sequence = open_sequence(tmp_path / "kept", Config().input)
    for frame, mine in zip(sequence, frames, strict=True):
        assert frame.timestamp_s == pytest.approx(mine.timestamp_s, abs=1e-6)
        assert (frame.rgb == mine.rgb).all()
        np.testing.assert_allclose(frame.depth_m, mine.depth_m, atol=0.00051)
    with pytest.raises(SlamError, match="the folder exists already"):
        next(example.recorded(frames, CAMERA, tmp_path / "kept"))


def test_any_iterator_of_frames_can_be_run(example, frames):
    assert len(example.run(CAMERA, iter(frames)).trajectory) == 12


def test_losing_and_finding_the_way_is_told(example, frames, capsys):
    dark = [Frame(f.timestamp_s, np.zeros_like(f.rgb), f.depth_m) for f in frames]
    result = example.run(CAMERA, [*frames[:4], *dark[4:6], *frames[6:]])
    told = capsys.readouterr().out
    assert len(result.untracked_s) == 2
    assert told.count("lost: ") == 1
    assert re.search(r"found again, by keyframe|s  keyframe 1", told)


def test_ctrl_c_ends_the_filming_and_keeps_what_was_filmed(example, frames):
    def interrupted():
        for i, frame in enumerate(frames):
            if i == 5:
                os.kill(os.getpid(), signal.SIGINT)
            yield frame

    assert len(example.run(CAMERA, interrupted()).trajectory) == 6


@pytest.fixture
def device(frames, monkeypatch):
    """Put a camera that is none in the place of pyrealsense2, with depth in half millimetres."""
    stopped = []

    def image(data, when_s=0.0):
        return SimpleNamespace(get_data=lambda: data, get_timestamp=lambda: 1000.0 * when_s)

    films = iter(frames)

    def wait():
        frame = next(films)
        return SimpleNamespace(
            get_color_frame=lambda: image(frame.rgb, frame.timestamp_s),
            get_depth_frame=lambda: image(np.rint(2000 * frame.depth_m).astype(np.uint16)),
        )

    lens = SimpleNamespace(
        width=320, height=240, fx=262.5, fy=262.5, ppx=159.5, ppy=119.5, coeffs=[0.0] * 5
    )
    stream = SimpleNamespace(
        as_video_stream_profile=lambda: SimpleNamespace(get_intrinsics=lambda: lens)
    )
    sensor = SimpleNamespace(get_depth_scale=lambda: 0.0005)
    profile = SimpleNamespace(
        get_device=lambda: SimpleNamespace(first_depth_sensor=lambda: sensor),
        get_stream=lambda _: stream,
    )
    pipeline = SimpleNamespace(
        start=lambda _: profile, wait_for_frames=wait, stop=lambda: stopped.append(True)
    )
    module = SimpleNamespace(
        pipeline=lambda: pipeline,
        config=lambda: SimpleNamespace(enable_stream=lambda *_: None),
        align=lambda _: SimpleNamespace(process=lambda images: images),
        stream=SimpleNamespace(color="color", depth="depth"),
        format=SimpleNamespace(rgb8="rgb8", z16="z16"),
    )
    monkeypatch.setitem(sys.modules, "pyrealsense2", module)
    return SimpleNamespace(pipeline=pipeline, stopped=stopped)


def test_a_realsense_gives_metres_seconds_and_its_lens(example, frames, device):
    camera, films = example.realsense()
    assert (camera.fx, camera.cy, camera.distortion) == (262.5, 119.5, (0.0,) * 5)
    assert camera.depth_scale == pytest.approx(2000.0)
    frame = next(films)
    assert frame.timestamp_s == pytest.approx(frames[0].timestamp_s)
    assert (frame.rgb == frames[0].rgb).all()
    np.testing.assert_allclose(frame.depth_m, frames[0].depth_m, atol=0.00026)
    films.close()
    assert device.stopped == [True]


def test_a_realsense_that_does_not_start_is_one_line(example, device, monkeypatch):
    def start(_):
        raise RuntimeError("No device connected")

    device.pipeline.start = start
    with pytest.raises(SlamError, match="the camera does not start: No device connected"):
        example.realsense()
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with pytest.raises(SlamError, match="pip install pyrealsense2"):
        example.realsense()
