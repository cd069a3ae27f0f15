# SPDX-License-Identifier: Apache-2.0
"""What GNC made of the loops, compared with the consensus, and what there is to doubt."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.pose_graph.graph import PoseGraph
from slam.pose_graph.live import squared_error_limit
from slam.pose_graph.motion_system import MotionSystem
from slam.pose_graph.second_opinion.bridges import bridge_doubts, rivals, with_rival
from slam.pose_graph.second_opinion.clusters import clusters
from slam.pose_graph.second_opinion.consensus import Consensus, consensus
from slam.pose_graph.second_opinion.drift import but_for_drift
from slam.types import FloatArray

# A loop is contested where one estimator believes it and to the other its error is more than this
# many times the limit, twice the residual: those near the limit bend the map little either way.
_CLEARLY_OUT = 4.0
_FORETOLD = 0.999  # so large a share of the true loops is where it was foretold
_NAMED = 3  # clusters
_MOST_RIVALS = 3  # from each of which a map is grown
_FEW_BY_CHANCE = 0.05
_ADVICE = "look at them in the loop ledger before trusting the result"


@dataclass(frozen=True)
class Opinion:
    """Which loops to believe.

    Attributes:
        kept: (L,) bool.
        T_world_kf: (K, 4, 4) float64 where they are not those that GNC believed, else None.
        doubts: one sentence each.
    """

    kept: NDArray[np.bool_]
    T_world_kf: FloatArray | None
    doubts: tuple[str, ...]


def second_opinion(
    graph: PoseGraph,
    system: MotionSystem,
    inlier_probability: float,
    kept: NDArray[np.bool_],
    squared: FloatArray,
    cost: float,
) -> Opinion:
    """Return what to believe of what GNC kept of L loops, with their (L,) squared errors then.

    Where the two clearly differ, only what was foretold is believed: a loop left out costs less
    than a false one. Else the answer of the smaller cost is: the sum of all squared errors, those
    of loops up to the limit.
    """
    limit = squared_error_limit(inlier_probability, graph.is_planar)
    wide = squared_error_limit(max(_FORETOLD, inlier_probability), graph.is_planar)
    found = _best_consensus(system, limit, wide, kept, squared)
    found, doubt = but_for_drift(system, limit, wide, kept, found)
    is_contested = contested(kept, squared / limit, found.squared / limit)
    of_drift = (f"{doubt}; {_ADVICE}",) if doubt else ()
    others = (*of_drift, *_doubt_of_chance(found), *_doubt_of_haste(found))
    # Where it did not come to an end, it knows too little to overrule GNC.
    if not is_contested.any() or not found.is_complete:
        cost += float((np.minimum(squared, wide) - np.minimum(squared, limit)).sum())
        is_better = found.cost < cost and (found.kept != kept).any()
        kept, T = (found.kept, found.T_world_kf) if is_better else (kept, None)
        squared = found.squared if is_better else squared
        bridges = doubts_of_bridges(graph, system, inlier_probability, kept, squared)
        return Opinion(kept, T, (*doubts(kept, is_contested), *bridges, *others))
    part = clusters(system, system.T_links, is_contested, wide)
    named = _named(graph, part, np.flatnonzero(is_contested), found)
    said = doubts(found.kept, is_contested, named)
    bridges = doubts_of_bridges(graph, system, inlier_probability, found.kept, found.squared)
    return Opinion(found.kept, found.T_world_kf, (*said, *bridges, *others))


def _best_consensus(
    system: MotionSystem,
    limit: float,
    wide: float,
    kept: NDArray[np.bool_],
    squared: FloatArray,
) -> Consensus:
    """Return what grows from the bridges that GNC kept, or from a rival where that costs less."""
    given = [kept & system.bridges]
    for rival in rivals(system, squared > _CLEARLY_OUT * limit, wide)[:_MOST_RIVALS]:
        given.append(with_rival(system, given[0], rival))
    found = [consensus(system, limit, wide, each) for each in given]
    return min(found, key=lambda each: (not each.is_complete, each.cost))


def contested(kept: NDArray[np.bool_], first: FloatArray, second: FloatArray) -> NDArray[np.bool_]:
    """Return which of L loops two estimators see clearly differently; the first keeps some.

    The (L,) squared errors are in units of the limit.
    """
    return np.where(kept, second > _CLEARLY_OUT, (second < 1.0) & (first > _CLEARLY_OUT))


def doubts(kept: NDArray[np.bool_], doubted: NDArray[np.bool_], named: str = "") -> tuple[str, ...]:
    """Return a sentence if all loops were rejected, or the estimators see some differently.

    The (L,) bool masks tell which loops are believed, and which are contested.
    """
    found = []
    if len(kept) and not kept.any():
        found.append(
            f"all {len(kept)} loops contradict the odometry or each other and were left out, so "
            f"the trajectory is the odometry's; {_ADVICE}"
        )
    if doubted.any():
        found.append(
            f"two robust estimators disagree on {doubted.sum()} of {len(kept)} loops "
            f"({kept.sum()} were kept, {(doubted & kept).sum()} of them contested){named}; "
            f"{_ADVICE}"
        )
    return tuple(found)


def doubts_of_bridges(
    graph: PoseGraph,
    system: MotionSystem,
    inlier_probability: float,
    kept: NDArray[np.bool_],
    squared: FloatArray,
) -> tuple[str, ...]:
    """Return what there is to doubt in the kept of L bridges, by the (L,) squared errors."""
    limit = squared_error_limit(inlier_probability, graph.is_planar)
    wide = squared_error_limit(max(_FORETOLD, inlier_probability), graph.is_planar)
    found = bridge_doubts(graph, system, kept, squared > _CLEARLY_OUT * limit, wide)
    return tuple(f"{each}; {_ADVICE}" for each in found)


def _doubt_of_chance(found: Consensus) -> tuple[str, ...]:
    if found.chance_fits < _FEW_BY_CHANCE or not found.kept.any():
        return ()
    left_out = np.count_nonzero(~found.kept)
    return (
        f"{left_out} loops were left out; of so many, {found.chance_fits:.2g} fit this map by "
        f"chance, so some that were kept may be false; {_ADVICE}",
    )


def _doubt_of_haste(found: Consensus) -> tuple[str, ...]:
    if found.is_complete:
        return ()
    return (
        f"the map is too large and its odometry too poor to foretell all {len(found.kept)} loops "
        f"one after the other, so some that were kept are unchecked; {_ADVICE}",
    )


def _named(
    graph: PoseGraph,
    part: NDArray[np.int64],
    loops: NDArray[np.int64],
    found: Consensus,
) -> str:
    """Return the largest clusters of the contested loops, and what is wrong with each."""
    links = list(graph.loops.values())
    sizes = np.bincount(part)
    texts = []
    for number in np.argsort(-sizes, kind="stable")[:_NAMED]:
        members = loops[part == number]
        ends = np.array([(links[i].ref_id, links[i].query_id) for i in members])
        (a, c), (b, d) = ends.min(axis=0), ends.max(axis=0)
        if 2 * found.kept[members].sum() > len(members):
            why = "kept, for the odometry and other loops foretell it"
        elif 2 * found.undecided[members].sum() > len(members):
            why = "left out, for the odometry cannot tell whether it is true"
        else:
            why = "left out, for the odometry and other loops contradict it"
        count = "one loop" if len(members) == 1 else f"{len(members)} loops that agree"
        texts.append(f"{count} of keyframes {a}-{b} and {c}-{d} ({why})")
    more = f", and {len(sizes) - _NAMED} more" if len(sizes) > _NAMED else ""
    return ": " + ", ".join(texts) + more
