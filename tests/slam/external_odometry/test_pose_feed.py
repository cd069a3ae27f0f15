# SPDX-License-Identifier: Apache-2.0
import math

import numpy as np

from slam.external_odometry.pose_feed import PoseFeed
from slam.types import Trajectory


class Taker:
    def __init__(self, time_offset_s=0.0):
        self.time_offset_s = time_offset_s
        self.taken_s = []

    def add_pose(self, timestamp_s, T_odom_cam):
        assert T_odom_cam[0, 3] == timestamp_s
        self.taken_s.append(timestamp_s)


def poses_at(stamps_s):
    T_odom_cam = np.tile(np.eye(4), (len(stamps_s), 1, 1))
    T_odom_cam[:, 0, 3] = stamps_s
    return Trajectory(np.array(stamps_s), T_odom_cam)


def test_an_image_has_the_poses_on_both_sides_of_it():
    taker = Taker()
    feed = PoseFeed(taker, poses_at([0.0, 1.0, 2.0, 3.0]))
    feed.until(0.5)
    assert taker.taken_s == [0.0, 1.0]
    feed.until(0.9)
    assert taker.taken_s == [0.0, 1.0]
    feed.until(1.0)  # the pose at that very time is there, and one more does no harm
    assert taker.taken_s == [0.0, 1.0, 2.0]
    feed.until(math.inf)
    assert taker.taken_s == [0.0, 1.0, 2.0, 3.0]


def test_poses_whose_clock_is_ahead_come_as_much_earlier():
    taker = Taker(time_offset_s=2.0)
    PoseFeed(taker, poses_at([0.0, 1.0, 2.0, 3.0])).until(0.5)
    assert taker.taken_s == [0.0, 1.0, 2.0, 3.0]


def test_without_another_odometry_nothing_comes():
    taker = Taker()
    PoseFeed(taker, None).until(math.inf)
    assert not taker.taken_s
