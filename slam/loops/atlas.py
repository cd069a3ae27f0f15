# SPDX-License-Identifier: Apache-2.0
"""The whole map: segments, and the submaps that loops join them to."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slam.config import GraphConfig
from slam.geometry import se3
from slam.loops.submaps import Submap, joined, submap_of
from slam.pose_graph import PoseGraph
from slam.types import FloatArray, Keyframe, Link, LoopAttempt, RelativePose, SlamError


@dataclass(frozen=True)
class AtlasSolution:
    """The largest submap, solved, and what is not in it.

    Attributes:
        T_world_kf: (K, 4, 4), NaN for the keyframes of other submaps.
        weights: trust per loop key, 0 (ignored) to 1.
        links: its motions that are no loops, those that join its segments among them.
        unjoined: per key of a loop in or to another submap, how many loops agree where that lies.
        warnings: one sentence each.
    """

    T_world_kf: FloatArray
    weights: dict[int, float]
    links: tuple[Link, ...]
    unjoined: dict[int, int]
    warnings: tuple[str, ...]


class Atlas:
    """Keyframes and motions, sorted into submaps that motions connect.

    Every segment has a pose graph of its own. When the map is solved, segments that loops join get
    one graph together, in which the loops between them are doubted as any other loop is.
    """

    def __init__(self, config: GraphConfig) -> None:
        self._config = config
        self._graphs = defaultdict[int, PoseGraph](lambda: PoseGraph(config))  # by segment
        self._keyframes: list[Keyframe] = []
        self._links: list[Link] = []
        self._loops: dict[int, Link] = {}

    def add(
        self, keyframe: Keyframe, links: Sequence[Link], attempts: Mapping[int, LoopAttempt]
    ) -> None:
        """Add the next keyframe, its motions to others of its segment, and its loops by key."""
        graph = self._graphs[keyframe.segment]
        T_world_kf = np.eye(4)
        if links:
            T_world_kf = graph.T_world_kf(links[0].ref_id) @ links[0].motion.T_ref_query
        graph.add_keyframe(keyframe.id, T_world_kf)
        self._keyframes.append(keyframe)
        for link in links:
            graph.add_link(link)
        self._links.extend(links)
        for key, attempt in attempts.items():
            if isinstance(attempt.outcome, RelativePose):
                loop = Link(attempt.match_id, attempt.query_id, attempt.outcome)
                self._loops[key] = loop
                if self._keyframes[loop.ref_id].segment == keyframe.segment:
                    graph.add_loop(key, loop.ref_id, loop.query_id, loop.motion)

    def finish(self, frames: Mapping[int, int] | None = None) -> AtlasSolution:
        """Solve the submap with the most frames per keyframe id, the earlier of equals."""
        submaps = self._submaps()
        largest = max(submaps, key=lambda submap: submap.size(frames))
        solution = self._graph(largest).finish()
        T_world_kf = np.full((len(self._keyframes), 4, 4), np.nan)
        T_world_kf[list(largest.T_submap_kf)] = solution.T_world_kf
        links, unjoined = tuple(largest.links), self._unjoined(submaps, largest)
        return AtlasSolution(T_world_kf, solution.weights, links, unjoined, solution.warnings)

    def T_world_odom(self, frames: Mapping[int, int] | None = None) -> FloatArray:
        """Return the (4, 4) correction of the odometry at the newest keyframe, as of now.

        Raises:
            SlamError: there is no keyframe yet, or it is not in the submap with the most frames.
        """
        if not self._keyframes:
            raise SlamError("there is no keyframe yet that a correction could be known of")
        newest = self._keyframes[-1]
        largest = max(self._submaps(), key=lambda submap: submap.size(frames))
        if newest.id not in largest.T_submap_kf:
            raise SlamError(
                "the camera was lost or began a new session, and so far no two loops agree where"
                " the part of the map that it is in now lies to the largest; ask again later"
            )
        graph = self._graph(largest)
        graph.update()
        return graph.T_world_kf(newest.id) @ se3.inverse(newest.T_odom_cam)

    def _submaps(self) -> list[Submap]:
        submaps = {segment: Submap({}, []) for segment in self._graphs}
        for keyframe in self._keyframes:
            submaps[keyframe.segment].T_submap_kf[keyframe.id] = keyframe.T_odom_cam
        for link in self._links:
            submaps[self._keyframes[link.ref_id].segment].links.append(link)
        return joined(list(submaps.values()), self._loops.values())

    def _graph(self, submap: Submap) -> PoseGraph:
        segments = {self._keyframes[k].segment for k in submap.T_submap_kf}
        if len(segments) == 1:
            return self._graphs[segments.pop()]
        graph = PoseGraph(self._config)
        T_world_submap = se3.inverse(submap.T_submap_kf[submap.first])
        for k, T_submap_kf in submap.T_submap_kf.items():
            graph.add_keyframe(k, T_world_submap @ T_submap_kf)
        for link in submap.links:
            graph.add_link(link)
        for key, loop in self._loops.items():
            if loop.ref_id in submap.T_submap_kf and loop.query_id in submap.T_submap_kf:
                graph.add_loop(key, loop.ref_id, loop.query_id, loop.motion)
        return graph

    def _unjoined(self, submaps: Sequence[Submap], largest: Submap) -> dict[int, int]:
        """Return, per loop not within the largest, how many loops join its submap to that."""
        number_of = submap_of(submaps)
        pairs = {
            key: {number_of[loop.ref_id], number_of[loop.query_id]}
            for key, loop in self._loops.items()
        }
        home = submaps.index(largest)
        near = {submap for pair in pairs.values() if home in pair for submap in pair} - {home}
        return {key: int(bool(pair & near)) for key, pair in pairs.items() if pair != {home}}


def in_one_odometry_frame(
    keyframes: Sequence[Keyframe], links: Sequence[Link]
) -> tuple[Keyframe, ...]:
    """Return keyframes whose T_odom_cam are those of one odometry, where links join their segments.

    A segment that no link leads to stays where it is.
    """
    below: dict[int, list[Link]] = defaultdict(list)
    for link in links:
        above, segment = (keyframes[k].segment for k in (link.ref_id, link.query_id))
        if above != segment:
            below[above].append(link)
    not_first = {keyframes[join.query_id].segment for joins in below.values() for join in joins}
    T_odom_segment = {each: np.eye(4) for each in below if each not in not_first}
    todo = list(T_odom_segment)
    for above in todo:
        for join in below[above]:
            ref, first = keyframes[join.ref_id], keyframes[join.query_id]
            T_odom_first = T_odom_segment[above] @ ref.T_odom_cam @ join.motion.T_ref_query
            T_odom_segment[first.segment] = T_odom_first @ se3.inverse(first.T_odom_cam)
            todo.append(first.segment)
    return tuple(
        replace(each, T_odom_cam=T_odom_segment[each.segment] @ each.T_odom_cam)
        if each.segment in not_first
        else each
        for each in keyframes
    )
