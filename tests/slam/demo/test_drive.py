# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.demo.drive import LAP_S, drive
from slam.demo.recording import FRAMES_PER_S
from slam.geometry import se3

FRAMES_PER_LAP = round(LAP_S * FRAMES_PER_S)


def motions(T_world_cam, frames):
    return se3.inverse(T_world_cam[:-frames]) @ T_world_cam[frames:]


@pytest.mark.parametrize("seed", range(5))
def test_a_camera_that_can_be_tracked_and_comes_back(seed):
    T_world_cam = drive(np.arange(2 * FRAMES_PER_LAP) / FRAMES_PER_S, seed)
    step = motions(T_world_cam, 1)
    assert se3.translation_norm(step).max() < 0.035
    assert np.degrees(se3.rotation_angle(step)).max() < 3.0
    lap = motions(T_world_cam, FRAMES_PER_LAP)
    apart_m, apart_deg = se3.translation_norm(lap), np.degrees(se3.rotation_angle(lap))
    assert 0.05 < np.median(apart_m) < 0.15 and apart_m.max() < 0.2
    assert 2.0 < np.median(apart_deg) < 15.0


def test_a_camera_held_upright_inside_the_room():
    T_world_cam = drive(np.arange(2 * FRAMES_PER_LAP) / FRAMES_PER_S, 0)
    R = T_world_cam[:, :3, :3]
    assert np.allclose(R @ R.transpose(0, 2, 1), np.eye(3))
    assert np.allclose(np.linalg.det(R), 1.0)
    assert (R[:, 2, 1] < -0.9).all()  # image down is world down
    assert (np.abs(T_world_cam[:, :2, 3]) < [1.0, 0.8]).all()
    assert (np.abs(T_world_cam[:, 2, 3] - 1.3) < 0.15).all()


def test_a_longer_drive_begins_like_a_shorter_one():
    assert np.array_equal(
        drive(np.arange(10) / FRAMES_PER_S, 1), drive(np.arange(90) / FRAMES_PER_S, 1)[:10]
    )
    assert not np.allclose(
        drive(np.arange(10) / FRAMES_PER_S, 1), drive(np.arange(10) / FRAMES_PER_S, 2)
    )
