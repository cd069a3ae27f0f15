# SPDX-License-Identifier: Apache-2.0
"""The part of a long run's graph that came since the whole was solved."""

from collections.abc import Iterable, Mapping
from dataclasses import replace

import numpy as np

from slam.geometry import se3
from slam.pose_graph.graph import PoseGraph
from slam.pose_graph.motion_system import start_from
from slam.types import FloatArray, Link, RelativePose

# Information, 0.1 mrad and 0.1 mm: far above that of all but a perfect odometry from elsewhere.
_STAYS = 1e8 * np.eye(6)


def unsettled_part(graph: PoseGraph, settled: Mapping[int, FloatArray]) -> PoseGraph:
    """Return the graph without what is settled, but for the keyframes that the rest hangs on.

    Of a graph's keyframes those settled are given as (4, 4) poses by id; they stay there, held by
    links from the first of them. The others begin where the odometry goes on from those.
    """
    links, steps = (tuple(_touching(each, settled)) for each in (graph.links, graph.steps))
    loops = {k: each for k, each in graph.loops.items() if not _is_settled(each, settled)}
    rest = (*links, *steps, *loops.values())
    touched = {k for each in rest for k in (each.ref_id, each.query_id)}
    held = [k for k in settled if k in touched] or [next(iter(settled))]
    T_start = start_from(graph.T_world_kf, settled)
    new = {k: T for k, T in zip(graph.T_world_kf, T_start, strict=True) if k not in settled}
    T_held_first = se3.inverse(settled[held[0]])
    holds = tuple(
        Link(held[0], k, RelativePose(T_held_first @ settled[k], _STAYS)) for k in held[1:]
    )
    T_world_kf = {**{k: settled[k] for k in held}, **new}
    return replace(graph, T_world_kf=T_world_kf, links=(*holds, *links), loops=loops, steps=steps)


def _touching(motions: Iterable[Link], settled: Mapping[int, FloatArray]) -> Iterable[Link]:
    return (each for each in motions if not _is_settled(each, settled))


def _is_settled(motion: Link, settled: Mapping[int, FloatArray]) -> bool:
    return motion.ref_id in settled and motion.query_id in settled
