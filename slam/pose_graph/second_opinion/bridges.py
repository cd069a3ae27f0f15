# SPDX-License-Identifier: Apache-2.0
"""Bridges: loops between pieces of the map that no odometry joins, as between two recordings.

Nothing foretells the first loop that leads over. A second one that agrees bears it out; others that
agree with each other instead are a rival, another answer to how the pieces lie.
"""

import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from slam.pose_graph.graph import PoseGraph
from slam.pose_graph.motion_system import MotionSystem
from slam.pose_graph.second_opinion.clusters import clusters
from slam.types import IntArray


def rivals(system: MotionSystem, is_out: NDArray[np.bool_], wide: float) -> list[IntArray]:
    """Return the numbers of bridges that agree with each other, two at least, the most first.

    They are sought among the (L,) loops that are clearly out. Loops from one piece to another are
    alike in direction, as the earlier place is every loop's reference.
    """
    found = []
    pieces = system.pieces[system.loop_ends]
    is_out = is_out & system.bridges
    for pair in np.unique(pieces[is_out], axis=0):
        chosen = is_out & (pieces == pair).all(axis=1)
        part = clusters(system, system.T_links, chosen, wide, most_apart=len(system.T_links))
        loops = np.flatnonzero(chosen)
        found += [loops[part == i] for i in np.flatnonzero(np.bincount(part) > 1)]
    return sorted(found, key=lambda loops: -len(loops))


def with_rival(system: MotionSystem, kept: NDArray[np.bool_], rival: IntArray) -> NDArray[np.bool_]:
    """Return (L,) the kept bridges, but of those between the pieces of a rival only the rival's."""
    pieces = np.sort(system.pieces[system.loop_ends], axis=1)
    given: NDArray[np.bool_] = kept & system.bridges & (pieces != pieces[rival[0]]).any(axis=1)
    given[rival] = True
    return given


def bridge_doubts(
    graph: PoseGraph,
    system: MotionSystem,
    kept: NDArray[np.bool_],
    is_out: NDArray[np.bool_],
    wide: float,
) -> tuple[str, ...]:
    """Return a sentence for every kept bridge that stands alone, and one for the largest rival.

    The (L,) masks are of loops that are kept, and that are clearly out.
    """
    if not system.bridges.any():
        return ()
    pieces = np.sort(system.pieces[system.loop_ends], axis=1)
    bridges = np.flatnonzero(kept & system.bridges)
    found = []
    for loop in bridges.tolist():
        others = pieces[bridges[bridges != loop]]
        if not _are_joined(pieces[loop], others, len(system.T_links)):
            found.append(
                f"one loop alone, of keyframes {_ends(graph, [loop])}, says how two parts of the "
                "map lie to each other that no odometry joins"
            )
    for rival in rivals(system, is_out, wide)[:1]:
        count = np.count_nonzero((pieces[bridges] == pieces[rival[0]]).all(axis=1))
        found.append(
            f"{len(rival)} loops that agree, of keyframes {_ends(graph, rival)}, contradict the "
            f"{count} kept on how two parts of the map lie that no odometry joins"
        )
    return tuple(found)


def _are_joined(pair: IntArray, others: IntArray, count: int) -> bool:
    """Return whether (N, 2) other pairs of pieces, of so many, join a pair of them."""
    edges = (np.ones(len(others)), (others[:, 0], others[:, 1]))
    joined = scipy.sparse.coo_array(edges, shape=(count, count))
    group = connected_components(joined, directed=False)[1]
    return bool(group[pair[0]] == group[pair[1]])


def _ends(graph: PoseGraph, loops: IntArray | list[int]) -> str:
    links = list(graph.loops.values())
    ends = np.array([(links[i].ref_id, links[i].query_id) for i in loops])
    (a, c), (b, d) = ends.min(axis=0), ends.max(axis=0)
    return f"{a} and {c}" if len(ends) == 1 else f"{a}-{b} and {c}-{d}"
