# SPDX-License-Identifier: Apache-2.0
import numpy as np

from slam.output.report.losses import losses
from slam.output.report.paths import gather


def found(result) -> list[tuple[float, float, int, str]]:
    each = losses(result, gather(result, None))
    return [(round(one.start_s, 3), round(one.stop_s, 3), one.frames, one.why) for one in each]


def test_without_losses_there_are_none(run) -> None:
    assert found(run.result) == []


def test_frames_in_a_row_are_one_loss(altered) -> None:
    lost_s = np.array([3.33, 3.36, 12.0301, 25.0])
    assert found(altered(untracked_s=lost_s)) == [
        (3.33, 3.36, 2, "not tracked"),
        (12.03, 12.03, 1, "not tracked"),
        (25.0, 25.0, 1, "not tracked"),
    ]


def test_what_was_not_joined_is_told_apart(altered) -> None:
    result = altered(untracked_s=np.array([21.0, 21.5, 22.0]), unjoined_s=np.array([21.5, 22.0]))
    assert found(result) == [
        (21.0, 21.0, 1, "not tracked"),
        (21.5, 22.0, 2, "part of the map that was not joined"),
    ]
