# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.external_odometry.trust import Trust, Verdict
from slam.loops.atlas import LargestSubmap
from slam.loops.cost_of_odometry import borne_out
from slam.pose_graph import GraphSolution, PoseGraph

TRUST = Trust(Verdict.BORNE_OUT, np.zeros(3), np.zeros(3), (), (), 100)


def solved_as(weights, keyframes=range(12)):
    return GraphSolution(dict.fromkeys(keyframes, np.eye(4)), weights)


@pytest.mark.parametrize(
    ("by_odometry", "by_images", "is_followed"),
    [
        (solved_as(dict.fromkeys(range(12), 1.0)), solved_as(dict.fromkeys(range(12), 1.0)), True),
        (
            solved_as({k: float(k > 3) for k in range(12)}),
            solved_as(dict.fromkeys(range(12), 1.0)),
            True,
        ),
        (
            solved_as({k: float(k > 4) for k in range(12)}),
            solved_as(dict.fromkeys(range(12), 1.0)),
            False,
        ),
        (solved_as(dict.fromkeys(range(12), 0.0)), solved_as(dict.fromkeys(range(12), 0.0)), True),
        (solved_as({0: 1.0}), solved_as(dict.fromkeys(range(1, 12), 1.0)), True),
        (
            solved_as(dict.fromkeys(range(12), 0.0)),
            solved_as(dict.fromkeys(range(12), 1.0), [0]),
            True,
        ),
    ],
    ids=["none lost", "few", "many", "false ones", "of another submap", "part known by it alone"],
)
def test_an_odometry_is_followed_unless_it_costs_many_loops(by_odometry, by_images, is_followed):
    largest, alone = (LargestSubmap(PoseGraph({}, (), {}), {}, {}, {}, TRUST, {}) for _ in range(2))
    answers = iter([by_odometry, by_images])
    found, solution = borne_out(largest, alone, lambda _: next(answers))
    assert solution is (by_odometry if is_followed else by_images)
    expected = Verdict.BORNE_OUT if is_followed else Verdict.CONTRADICTED
    assert found.trust.verdict is expected
