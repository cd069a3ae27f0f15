# SPDX-License-Identifier: Apache-2.0
"""What an odometry from elsewhere costs: loops that images alone would keep."""

from collections.abc import Callable
from dataclasses import replace

from slam.external_odometry.trust import Verdict
from slam.loops.atlas import LargestSubmap
from slam.pose_graph import GraphSolution, PoseGraph
from slam.types import MIN_TRUSTED_WEIGHT

# Of the loops that images alone would keep, an odometry may cost so many, and this share: the truth
# of fr1_desk costs 6 of 39.
_MAY_OUTVOTE, _MAY_OUTVOTE_SHARE = 4, 0.25


def borne_out(
    largest: LargestSubmap,
    by_images: LargestSubmap,
    solved: Callable[[PoseGraph], GraphSolution],
) -> tuple[LargestSubmap, GraphSolution]:
    """Return a submap and its solution: that by images alone, where loops bear out no other.

    What slips slowly may agree with every motion over a short way. It is stiff in the graph then,
    and loops that agree with the images and with each other are outvoted.
    """
    solution, trust = solved(largest.graph), largest.trust
    if by_images is largest or trust is None:
        return largest, solution
    alone = solved(by_images.graph)
    if solution.T_world_kf.keys() - alone.T_world_kf.keys():
        return largest, solution  # only the odometry knows where some of it is
    kept = {key for key, weight in alone.weights.items() if weight > MIN_TRUSTED_WEIGHT}
    lost = [key for key in kept if solution.weights.get(key, 1.0) <= MIN_TRUSTED_WEIGHT]
    if len(lost) <= max(_MAY_OUTVOTE, _MAY_OUTVOTE_SHARE * len(kept)):
        return largest, solution
    doubted = replace(trust, verdict=Verdict.CONTRADICTED, steps=())
    return replace(by_images, trust=doubted), alone
