# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.config import InputConfig
from slam.datasets import Sessions, open_sequence, read_camera, write_camera
from slam.types import SlamError


@pytest.fixture
def make_session(make_folder):
    """Open a recording of six tiny frames, 0.1 s apart, with true poses 9 s before and after."""

    def make(name, later_s=0.0, has_truth=True, **camera):
        folder = make_folder(name=name)
        for kind in ("rgb", "depth"):
            first, *lines = (folder / f"{kind}.txt").read_text().splitlines()
            moved = [f"{float(line.split()[0]) + later_s:.6f} {line.split()[1]}" for line in lines]
            (folder / f"{kind}.txt").write_text("\n".join([first, *moved]) + "\n")
        if has_truth:
            stamps_s = 100.0 + later_s + np.arange(-9.0, 9.0, 0.1)
            text = "".join(f"{each:.6f} {later_s} 0 0 0 0 0 1\n" for each in stamps_s)
            (folder / "groundtruth.txt").write_text(text)
        if camera:
            changed = replace(read_camera(folder / "camera.toml"), **camera)
            write_camera(folder / "camera.toml", changed)
        return open_sequence(folder, InputConfig())

    return make


def test_one_recording_is_a_session_as_it_is(make_session):
    recording = make_session("one")
    alone = Sessions([recording])
    assert alone.recordings == [recording] and alone.camera is recording.camera
    truth = recording.ground_truth
    np.testing.assert_array_equal(alone.ground_truth.timestamps_s, truth.timestamps_s)
    assert alone.warnings == recording.warnings


def test_the_truth_of_several_follows_one_another(make_session):
    both = Sessions([make_session("one"), make_session("two", later_s=10.0)])
    stamps_s = both.ground_truth.timestamps_s
    assert (np.diff(stamps_s) > 0.0).all() and len(stamps_s) > 250
    is_second = both.ground_truth.T_world_cam[:, 0, 3] == 10.0
    np.testing.assert_array_equal(is_second, stamps_s > 0.5 * (100.5 + 110.0))
    assert any("taken to be in one frame of reference" in each for each in both.warnings)


def test_whose_truth_is_missing_is_said(make_session):
    both = Sessions([make_session("one"), make_session("two", later_s=10.0, has_truth=False)])
    assert both.ground_truth.timestamps_s[-1] < 106.0
    assert "only one can be compared with ground truth" in both.warnings
    neither = [make_session("three", has_truth=False), make_session("four", 10.0, has_truth=False)]
    assert Sessions(neither).ground_truth is None


def test_warnings_name_their_recording(make_session):
    wide = {"fx": 3.0, "fy": 3.0}
    both = Sessions([make_session("one", **wide), make_session("two", later_s=10.0, **wide)])
    for recording in both.recordings:
        (doubt,) = (each for each in recording.warnings if "field of view" in each)
        assert f"{recording.name}: {doubt}" in both.warnings


def complaint(*recordings):
    with pytest.raises(SlamError) as error:
        Sessions(list(recordings))
    assert "\n" not in str(error.value)
    return str(error.value)


def test_another_order_is_put_right(make_session):
    told = complaint(make_session("late", later_s=10.0), make_session("early"))
    assert "put early, which ends at 100.500 s, before late, which begins at 110.000 s" in told


def test_recordings_of_one_time_are_no_sessions(make_session):
    told = complaint(make_session("one"), make_session("two", later_s=0.3))
    assert "one ends at 100.500 s, two begins at 100.300 s" in told


def test_another_camera_is_refused(make_session):
    told = complaint(make_session("one"), make_session("two", later_s=10.0, fx=31.0))
    assert "different cameras" in told and "one has fx 30.0, two fx 31.0;" in told


def test_what_differs_between_cameras_is_told_however_little(make_session):
    bent = {"fx": 30.000001, "distortion": (0.1, 0.0, 0.0, 0.0, 0.0)}
    one = make_session("one", distortion=(0.2, 0.0, 0.0, 0.0, 0.0))
    told = complaint(one, make_session("two", later_s=10.0, **bent))
    assert "one has fx 30.0, distortion (0.2, 0.0, 0.0, 0.0, 0.0), two fx 30.000001," in told
