# SPDX-License-Identifier: Apache-2.0
"""An odometry that drifts further than its links say, and whether loops tell so or are false."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from slam.pose_graph.live import squared_error_limit
from slam.pose_graph.motion_system import MotionSystem
from slam.pose_graph.second_opinion.consensus import Consensus, consensus, squared_errors
from slam.types import FloatArray

# An odometry may drift so many times as far as its links say; our own came to 1.1 to 2.0 over a lap
# of seven rendered rooms.
_MOST_DRIFT = 3.0
# The least variance of where believed loops are then, as a share of that of all poses: seven tenths
# of a straight way have it, and nearly half of a round.
_ALL_OVER = 0.5


def but_for_drift(
    system: MotionSystem,
    limit: float,
    wide: float,
    kept: NDArray[np.bool_],
    found: Consensus,
) -> tuple[Consensus, str | None]:
    """Where nothing is foretold, return what is if links claim too much, and a sentence of doubt.

    A loop that is foretold tells that links can be relied on: what contradicts them is false then.
    """
    if found.kept.any() or not kept.any() or not found.is_complete:
        return found, None
    times = drift(system, kept)
    if times <= 1.0:
        return found, None
    despite = _foretold_despite(times, system, limit, wide, kept)
    if despite is None:
        count = np.count_nonzero(kept)
        loops = "one loop" if count == 1 else f"{count} loops that agree"
        return found, (
            f"for {loops} to be true the odometry would have to drift {times:.1f} times as far as "
            "its links claim"
        )
    # What it costs is reckoned as for all others.
    cost = system.links_cost(despite.T_world_kf) + float(np.minimum(despite.squared, wide).sum())
    return replace(despite, cost=cost), (
        f"the odometry drifts {times:.1f} times as far as its links claim, if the loops are true, "
        "which agree on it all over the map"
    )


def drift(system: MotionSystem, kept: NDArray[np.bool_]) -> float:
    """Return how many times as far as its links say an odometry is off, by most of L kept loops.

    Links are taken for independent, so what a way is off grows with the root of its length. What
    bends one link often bends the next alike, as a wrong scale does, and then it grows with the
    length: over a lap every true loop is beyond what the links foretell, by about one factor.
    """
    alone = system.with_only(np.zeros(system.loop_count, np.bool_))
    errors, covariance = system.with_only(kept).predicted(
        system.T_links, alone.draws(system.T_links)
    )
    typical = float(np.median(squared_errors(errors, covariance)))
    return float(np.sqrt(typical / squared_error_limit(0.5, system.is_planar)))


def _foretold_despite(
    times: float, system: MotionSystem, limit: float, wide: float, kept: NDArray[np.bool_]
) -> Consensus | None:
    """Return what an odometry foretells that drifts so many times as far as its links say.

    False loops that agree with each other say it, too, but for two things: they are rarely so near,
    and those of places that look alike lie at these places only. So it is None where that is too
    far, or not most of the L kept loops are foretold then, or those that are lie at one place.
    """
    if times > _MOST_DRIFT:
        return None
    found = consensus(system.drifting(times), limit, wide, kept & system.bridges)
    agreed = found.kept & kept
    is_most = 2 * np.count_nonzero(agreed) > np.count_nonzero(kept)
    if not found.is_complete or not is_most or not _are_all_over(system, found.T_world_kf, agreed):
        return None
    return found


def _are_all_over(system: MotionSystem, T_world_kf: FloatArray, kept: NDArray[np.bool_]) -> bool:
    """Return whether L kept loops lie all over the map of (K, 4, 4) poses."""
    positions_m = T_world_kf[:, :3, 3]
    places_m = positions_m[system.loop_ends[kept, 0]]
    return bool(places_m.var(axis=0).sum() > _ALL_OVER * positions_m.var(axis=0).sum())
