# SPDX-License-Identifier: Apache-2.0
"""A run that goes on from the map of an earlier one."""

from dataclasses import replace

import numpy as np
import pytest

from placerec.recognizers.gradients import GradientRecognizer
from slam.output.map_folder.folder import load_map, save_map, saved_map
from slam.system import Slam
from slam.types import Camera, Rejection, SlamError

OTHER_CAMERA = Camera(350, 260, 328.125, 328.125, 174.5, 129.5)
FIRST = 40
"""Frames that make the map; the camera then comes back to where it began."""


@pytest.fixture(scope="module")
def folder(frames, sequence, tmp_path_factory):
    slam = Slam(sequence.camera, GradientRecognizer())
    for frame in frames[:FIRST]:
        slam.process(frame)
    folder = tmp_path_factory.mktemp("maps") / "room"
    save_map(folder, saved_map(slam, slam.finish()))
    return folder


def on(folder, camera, is_fixed=False):
    return Slam(
        camera,
        GradientRecognizer(),
        earlier=load_map(folder, GradientRecognizer()),
        is_fixed=is_fixed,
    )


def content(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def earlier_clock(frame):
    return replace(frame, timestamp_s=frame.timestamp_s - 1000.0)


def upside_down(frame):
    return replace(frame, rgb=frame.rgb[::-1].copy(), depth_m=frame.depth_m[::-1].copy())


def error_m(trajectory, T_first_cam):
    return np.linalg.norm((trajectory.T_world_cam - T_first_cam)[:, :3, 3], axis=1)


def test_a_later_run_is_placed_in_the_map_and_extends_it(folder, frames, sequence, T_first_cam):
    slam = on(folder, sequence.camera)
    count = len(slam.earlier.keyframes)
    first = slam.process(frames[FIRST])
    placed = slam.T_world_odom() @ first.T_odom_cam
    assert np.linalg.norm((placed - T_first_cam[FIRST])[:3, 3]) < 0.03
    for frame in frames[FIRST + 1 :]:
        slam.process(frame)
    result = slam.finish()
    assert len(result.trajectory) == len(frames) - FIRST and not len(result.untracked_s)
    assert error_m(result.trajectory, T_first_cam[FIRST:]).max() < 0.03
    saved = saved_map(slam, result)
    assert len(saved.keyframes) == len(result.keyframes) > count
    assert saved.sessions.tolist() == [0] * count + [1] * (len(saved.keyframes) - count)
    assert saved.frames.sum() == len(frames)
    assert len(saved.ledger) == len(result.attempts) - len(load(folder).attempts) + len(
        load(folder).ledger
    )


def load(folder):
    return load_map(folder, GradientRecognizer())


def test_the_extended_map_is_saved_and_gone_on_from_again(folder, frames, sequence, tmp_path):
    slam = on(folder, sequence.camera)
    for frame in frames[FIRST:50]:
        slam.process(frame)
    save_map(tmp_path / "map", saved_map(slam, slam.finish()))
    later = on(tmp_path / "map", sequence.camera)
    assert not isinstance(later.process(frames[50]), Rejection)
    assert later.finish().T_world_kf.shape == (len(later.earlier.keyframes) + 1, 4, 4)


@pytest.mark.parametrize("stamped", [lambda frame: frame, earlier_clock])
def test_in_a_fixed_map_frames_are_placed_and_nothing_changes(
    folder, frames, sequence, T_first_cam, stamped
):
    before = content(folder)
    slam = on(folder, sequence.camera, is_fixed=True)
    for frame, T in zip(frames[FIRST:], T_first_cam[FIRST:], strict=True):
        tracked = slam.process(stamped(frame))
        assert tracked.new_keyframe is None
        assert np.linalg.norm((slam.T_world_odom() @ tracked.T_odom_cam - T)[:3, 3]) < 0.03
    result = slam.finish()
    assert error_m(result.trajectory, T_first_cam[FIRST:]).max() < 0.03
    np.testing.assert_array_equal(result.live.T_world_cam, result.trajectory.T_world_cam)
    T_map_kf = np.array([each.T_odom_cam for each in load(folder).keyframes])
    np.testing.assert_array_equal(result.T_world_kf, T_map_kf)
    assert saved_map(slam, result).ledger == slam.earlier.ledger
    assert content(folder) == before


def test_what_is_not_in_a_fixed_map_is_not_placed(folder, frames, sequence):
    slam = on(folder, sequence.camera, is_fixed=True)
    assert all(isinstance(slam.process(upside_down(each)), Rejection) for each in frames[:3])
    assert not slam.has_keyframes
    with pytest.raises(SlamError, match="no frame could be placed"):
        slam.finish()
    assert not isinstance(slam.process(frames[5]), Rejection)


def test_what_is_not_in_the_map_is_a_part_of_its_own(folder, frames, sequence):
    """The map stays the world, however much more the other part has."""
    slam = on(folder, sequence.camera)
    count = len(slam.earlier.keyframes)
    for each in frames[:30]:
        tracked = slam.process(upside_down(each))
    assert tracked.segment == 1
    with pytest.raises(SlamError, match="no frame could be placed in the map"):
        slam.finish()
    slam.start_session()
    assert slam.process(frames[50]).segment == 0
    result = slam.finish()
    assert np.isfinite(result.T_world_kf[:count]).all() and len(result.trajectory) == 1
    assert any("30 of 31 frames" in warning for warning in result.warnings)
    assert len(saved_map(slam, result).keyframes) == count + 1


def test_another_camera_goes_on_from_the_map_and_both_are_saved(
    folder, frames, sequence, T_first_cam, by_another_camera, tmp_path
):
    slam = on(folder, OTHER_CAMERA)
    for frame in frames[FIRST:50]:
        slam.process(by_another_camera(frame))
    result = slam.finish()
    assert error_m(result.trajectory, T_first_cam[FIRST:50]).max() < 0.03
    save_map(tmp_path / "map", saved_map(slam, result))
    loaded = load(tmp_path / "map")
    count = len(slam.earlier.keyframes)
    cameras = [each.camera for each in loaded.keyframes]
    assert cameras == [sequence.camera] * count + [OTHER_CAMERA] * (len(cameras) - count)
    shapes = [each.preview.rgb.shape for each in loaded.keyframes[count - 1 : count + 1]]
    assert shapes == [(120, 160, 3), (130, 175, 3)]


def test_an_odometry_from_elsewhere_is_refused(folder, frames, sequence):
    slam = on(folder, sequence.camera)
    for give in (lambda: slam.process(frames[0], np.eye(4)), lambda: slam.add_pose(1.0, np.eye(4))):
        with pytest.raises(SlamError, match="together with an earlier map"):
            give()
