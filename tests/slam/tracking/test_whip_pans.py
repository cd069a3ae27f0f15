# SPDX-License-Identifier: Apache-2.0
"""A camera that looks one way, is torn round within a few smeared images, and comes back."""

import numpy as np
import pytest

from placerec.recognizers.gradients import GradientRecognizer
from slam.demo import render
from slam.demo.kinect_noise import add_colour_noise, add_kinect_noise
from slam.geometry import se3
from slam.system import Slam
from slam.types import Camera, Frame, Rejection, RejectionReason

CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
PAN_RAD, PAN_S, EXPOSURE_S = np.radians(75.0), 0.25, 0.02
PANS_S = (1.0, 2.5)  # there and back
LEVEL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])  # looking along x


def pose(time_s):
    """Return T_world_cam of a hand that drifts and pans."""
    done = [np.clip((time_s - start_s) / PAN_S, 0.0, 1.0) for start_s in PANS_S]
    there, back = (share * share * (3.0 - 2.0 * share) for share in done)
    yaw = 0.3 + PAN_RAD * (there - back) + 0.05 * np.sin(1.3 * time_s)
    T_world_cam = se3.exp(np.array([0.0, 0.0, yaw, 0.0, 0.0, 0.0]))
    T_world_cam[:3, :3] = T_world_cam[:3, :3] @ LEVEL
    T_world_cam[:3, 3] = 0.2 * np.sin(0.8 * time_s), 0.15 * np.sin(0.9 * time_s), 1.3
    return T_world_cam


def times_s():
    """Return when images are taken: 10 a second, and 30 during a pan."""
    slow = np.arange(0.0, 3.9, 0.1)
    pans = [start_s + np.arange(1, 8) / 30.0 for start_s in PANS_S]
    is_slow = np.all([(slow <= start_s) | (slow > start_s + PAN_S) for start_s in PANS_S], axis=0)
    return np.sort(np.concatenate([slow[is_slow], *pans]))


@pytest.fixture(scope="module")
def frames(built_rooms):
    room, taken = built_rooms(0), []
    for i, time_s in enumerate(times_s()):
        during_s = time_s + np.linspace(-0.5, 0.5, 7) * EXPOSURE_S
        ends = [pose(during_s[0]), pose(during_s[-1])]
        is_fast = se3.rotation_angle(se3.inverse(ends[0]) @ ends[1]) * CAMERA.fx > 1.0
        middle = render(room, CAMERA, pose(time_s))
        seen = (
            [render(room, CAMERA, pose(each)).rgb for each in during_s] if is_fast else [middle.rgb]
        )
        rng = np.random.default_rng([7, i])
        rgb = add_colour_noise(np.mean(seen, axis=0).astype(np.uint8), rng)
        taken.append(Frame(time_s, rgb, add_kinect_noise(middle.depth_m, CAMERA, rng)))
    return taken


def test_no_frame_is_placed_far_off_and_what_is_not_sure_is_apart(frames):
    slam = Slam(CAMERA, GradientRecognizer())
    tracked = [slam.process(frame) for frame in frames]
    truth = np.array([pose(frame.timestamp_s) for frame in frames])
    fast = [any(s < frame.timestamp_s < s + PAN_S for s in PANS_S) for frame in frames]
    reasons = {each.reason for each in tracked if isinstance(each, Rejection)}
    assert RejectionReason.SMEARED in reasons
    assert all(
        is_fast for is_fast, each in zip(fast, tracked, strict=True) if isinstance(each, Rejection)
    )
    index_of = {frame.timestamp_s: i for i, frame in enumerate(frames)}
    trajectory = slam.finish().trajectory
    T_truth_cam = truth[[index_of[each] for each in trajectory.timestamps_s]]
    T_truth_world = T_truth_cam[0] @ se3.inverse(trajectory.T_world_cam[0])
    error_m = se3.translation_norm(
        se3.inverse(T_truth_cam) @ T_truth_world @ trajectory.T_world_cam
    )
    assert error_m.max() < 0.05
    # Live, too: what comes back to where it was is in the segment of then.
    first, last = tracked[0], tracked[-1]
    T_first_last = se3.inverse(first.T_odom_cam) @ last.T_odom_cam
    assert first.segment == last.segment
    error = se3.inverse(se3.inverse(truth[0]) @ truth[-1]) @ T_first_last
    assert se3.translation_norm(error) < 0.05
