# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from slam import Camera, Config, open_sequence, read_tum
from slam.evaluation.drift import trajectory_error

SMALL_CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)


@pytest.fixture(scope="module")
def ran(example, recording, tmp_path_factory):
    """Run once; return the sequence, the result and the file of Open3D's poses."""
    sequence = open_sequence(recording, Config().input)
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
def test_where_open3d_has_nothing_to_compare_the_last_motion_goes_on(example, recording, missing):
    frames = list(open_sequence(recording, Config().input))[:3]
    odometry = example.Open3dOdometry(SMALL_CAMERA)
    T = [odometry.place(frame) for frame in frames[:2]]
    blind = replace(frames[2], **{missing: np.zeros_like(getattr(frames[2], missing))})
    T.append(odometry.place(blind))
    assert odometry.failed == 1
    np.testing.assert_allclose(T[2], T[1] @ np.linalg.inv(T[0]) @ T[1], atol=1e-9)
