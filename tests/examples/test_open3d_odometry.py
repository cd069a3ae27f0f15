# SPDX-License-Identifier: Apache-2.0
import importlib.util
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from slam import Camera, Config, open_sequence, read_tum
from slam.demo.recording import render_sequence
from slam.evaluation.drift import trajectory_error

EXAMPLE = Path(__file__).parents[2] / "examples" / "open3d_odometry.py"
SMALL_CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location(EXAMPLE.stem, EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Render a third of the room, there by every other image and back by the rest, in 8 s."""
    folder = tmp_path_factory.mktemp("rendered") / "there_and_back"
    render_sequence(folder, seconds=4.0, camera=SMALL_CAMERA)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        _, *lines = (folder / name).read_text().splitlines()
        tour = [*lines[::2], *lines[::-2]]
        stamped = [f"{i / 7.5:.6f} {line.split(' ', 1)[1]}\n" for i, line in enumerate(tour)]
        (folder / name).write_text("".join(stamped))
    return folder


@pytest.fixture(scope="module")
def ran(example, folder, tmp_path_factory):
    """Run once; return the sequence, the result and the file of Open3D's poses."""
    sequence = open_sequence(folder, Config().input)
    file = tmp_path_factory.mktemp("poses") / "poses.txt"
    return SimpleNamespace(
        truth=sequence.ground_truth, result=example.close_loops(sequence, file), file=file
    )


def test_the_drift_of_open3d_goes_away(ran):
    before, after = (
        trajectory_error(each, ran.truth, Config().evaluation).ate_rmse_m
        for each in (ran.result.given.given, ran.result.given.corrected)
    )
    assert after < 0.5 * before


def test_a_few_steps_that_open3d_gets_wrong_do_not_make_its_poses_those_of_another_recording(ran):
    assert ran.result.given.fits


def test_the_file_holds_the_poses_that_were_handed_over(ran):
    written, given = read_tum(ran.file), ran.result.given.given
    np.testing.assert_allclose(written.timestamps_s, given.timestamps_s, atol=1e-6)
    np.testing.assert_allclose(written.T_world_cam, given.T_world_cam, atol=1e-6)


@pytest.mark.parametrize("missing", ["depth_m", "rgb"])
def test_where_open3d_has_nothing_to_compare_the_last_motion_goes_on(example, folder, missing):
    frames = list(open_sequence(folder, Config().input))[:3]
    odometry = example.Open3dOdometry(SMALL_CAMERA)
    T = [odometry.place(frame) for frame in frames[:2]]
    blind = replace(frames[2], **{missing: np.zeros_like(getattr(frames[2], missing))})
    T.append(odometry.place(blind))
    assert odometry.failed == 1
    np.testing.assert_allclose(T[2], T[1] @ np.linalg.inv(T[0]) @ T[1], atol=1e-9)
