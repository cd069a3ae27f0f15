# SPDX-License-Identifier: Apache-2.0
from collections import Counter

import numpy as np

from slam.loops.on_the_way.schedule import CorrectionSchedule
from slam.types import Keyframe


def keyframe(k, segment=0):
    return Keyframe(k, float(k), np.eye(4), None, None, segment=segment)


def test_a_correction_is_due_when_a_tenth_more_loops_came():
    schedule, due = CorrectionSchedule(), []
    for loops in range(31):
        if schedule.is_due(keyframe(loops), Counter({0: loops}), has_given_pose=False):
            due.append(loops)
    assert due == [*range(1, 11), *range(12, 21, 2), *range(23, 31, 3)]


def test_every_segment_counts_its_own_loops():
    schedule = CorrectionSchedule()
    assert schedule.is_due(keyframe(50), Counter({0: 50}), has_given_pose=False)
    assert not schedule.is_due(keyframe(51), Counter({0: 51}), has_given_pose=False)
    assert schedule.is_due(keyframe(52, segment=1), Counter({0: 51, 1: 1}), has_given_pose=False)


def test_an_odometry_from_elsewhere_is_judged_without_a_loop_too():
    schedule = CorrectionSchedule()
    due = [k for k in range(40) if schedule.is_due(keyframe(k), Counter(), has_given_pose=True)]
    assert due[:3] == [1, 3, 5] and due[-1] - due[-2] == 5
    assert not schedule.is_due(keyframe(90), Counter(), has_given_pose=False)
