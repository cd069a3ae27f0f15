# SPDX-License-Identifier: Apache-2.0
"""The parts of the map: segments, and what loops between them join."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slam import se3
from slam.config import GraphConfig
from slam.pose_graph import PoseGraph
from slam.types import FloatArray, Keyframe, Link, LoopAttempt, RelativePose

NEEDED_LOOPS = 2
"""Loops that have to agree on how two parts lie to each other before the two become one."""

# Two loops agree where one puts the other's keyframe no further than this from where that does. Of
# 659 motions verified between all keyframes of fr1_xyz and fr1_desk 5 were off by more, none by
# more than 14 cm or 7 degrees: those were blurred views, not other places.
_AGREE_M, _AGREE_RAD = 0.10, np.radians(5.0)
_HYPOTHESES = 200  # of more loops between two parts some are asked, and all of them vote
_NEXT_TO_NOTHING = np.eye(6)  # of information: 1 rad, 1 m


@dataclass(frozen=True)
class AtlasSolution:
    """The largest part of the map, solved, and what is no part of it.

    Attributes:
        T_world_kf: (K, 4, 4), NaN for the keyframes of other parts.
        weights: trust per loop key, 0 (ignored) to 1.
        links: its motions that are no loops, those that tie its segments among them.
        unjoined: per key of a loop in or to another part, how many loops agree on where that lies.
        warnings: one sentence each.
    """

    T_world_kf: FloatArray
    weights: dict[int, float]
    links: tuple[Link, ...]
    unjoined: dict[int, int]
    warnings: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Part:
    """Keyframes that hang together.

    Attributes:
        T_part_kf: (4, 4) by keyframe id; the first is the part's origin.
        links: each ties a keyframe to those before it, or is one more between such.
    """

    T_part_kf: dict[int, FloatArray]
    links: list[Link]

    @property
    def first(self) -> int:
        return next(iter(self.T_part_kf))

    def places(self, keyframe_ids: Sequence[int]) -> FloatArray:
        return np.array([self.T_part_kf[k] for k in keyframe_ids])


class Atlas:
    """Keyframes and motions, sorted into parts of the map that hang together.

    While the camera runs, every segment has a pose graph of its own. In the end those parts are
    joined, one pair after the other, that most verified loops agree on, so that a false loop that
    came early has no say against those that came later. What ties two parts is worth next to
    nothing: it says from where the solver starts, and all loops between them have to prove
    themselves in the graph as any other loop has to.
    """

    def __init__(self, config: GraphConfig) -> None:
        self._config = config
        self._graphs: dict[int, PoseGraph] = {}  # by segment
        self._segment_of: list[int] = []  # by keyframe
        self._links: list[Link] = []
        self._loops: dict[int, Link] = {}

    def add(
        self, keyframe: Keyframe, links: Sequence[Link], attempts: Mapping[int, LoopAttempt]
    ) -> None:
        """Add the next keyframe, its motions to others of its segment, and its loops by key."""
        if keyframe.segment not in self._graphs:
            self._graphs[keyframe.segment] = PoseGraph(self._config)
        graph = self._graphs[keyframe.segment]
        T_world_kf = np.eye(4)
        if links:
            T_world_kf = graph.T_world_kf(links[0].ref_id) @ links[0].motion.T_ref_query
        graph.add_keyframe(keyframe.id, T_world_kf)
        self._segment_of.append(keyframe.segment)
        for link in links:
            graph.add_link(link)
        self._links.extend(links)
        for key, attempt in attempts.items():
            if isinstance(attempt.outcome, RelativePose):
                loop = Link(attempt.match_id, attempt.query_id, attempt.outcome)
                self._loops[key] = loop
                if self._segment_of[loop.ref_id] == keyframe.segment:
                    graph.add_loop(key, loop.ref_id, loop.query_id, loop.motion)
        graph.update()

    def finish(self, frames: Mapping[int, int]) -> AtlasSolution:
        """Solve the part with the most frames, the earlier of equals; frames are per keyframe."""
        parts = self._joined()
        sizes = [sum(frames.get(k, 0) for k in part.T_part_kf) for part in parts]
        largest = parts[int(np.argmax(sizes))]
        solution = self._graph(largest).finish()
        T_world_kf = np.full((len(self._segment_of), 4, 4), np.nan)
        T_world_kf[list(largest.T_part_kf)] = solution.T_world_kf
        return AtlasSolution(
            T_world_kf,
            solution.weights,
            tuple(largest.links),
            self._unjoined(parts, largest),
            solution.warnings,
        )

    def _segments(self) -> list[_Part]:
        T_part_kf: dict[int, dict[int, FloatArray]] = {each: {} for each in self._graphs}
        links: dict[int, list[Link]] = {each: [] for each in self._graphs}
        for k, segment in enumerate(self._segment_of):
            T_part_kf[segment][k] = self._graphs[segment].T_world_kf(k)
        for link in self._links:
            links[self._segment_of[link.ref_id]].append(link)
        return [_Part(T_part_kf[each], links[each]) for each in self._graphs]

    def _joined(self) -> list[_Part]:
        """Return the parts, in the order of time, between which no loops agree any more."""
        parts = self._segments() or [_Part({}, [])]
        while len(parts) > 1:
            ties = [
                (*_tie(parts[i], parts[j], loops), i, j)
                for (i, j), loops in self._between(parts).items()
            ]
            votes, tie, i, j = max(ties, key=lambda each: each[0], default=(0, None, 0, 0))
            if tie is None or votes < NEEDED_LOOPS:
                break
            parts[i] = _union(parts[i], parts.pop(j), tie)
        return parts

    def _between(self, parts: Sequence[_Part]) -> dict[tuple[int, int], list[Link]]:
        """Return the loops between any two parts, all seen from the earlier."""
        part_of = _part_of(parts)
        between: dict[tuple[int, int], list[Link]] = defaultdict(list)
        for loop in self._loops.values():
            i, j = part_of[loop.ref_id], part_of[loop.query_id]
            if i < j:
                between[i, j].append(loop)
            elif j < i:
                between[j, i].append(_reversed(loop))
        return between

    def _graph(self, part: _Part) -> PoseGraph:
        segments = {self._segment_of[k] for k in part.T_part_kf}
        if len(segments) == 1:
            return self._graphs[segments.pop()]
        graph = PoseGraph(self._config)
        for k, T_part_kf in part.T_part_kf.items():
            graph.add_keyframe(k, T_part_kf)
        for link in part.links:
            graph.add_link(link)
        for key, loop in self._loops.items():
            if loop.ref_id in part.T_part_kf and loop.query_id in part.T_part_kf:
                graph.add_loop(key, loop.ref_id, loop.query_id, loop.motion)
        return graph

    def _unjoined(self, parts: Sequence[_Part], largest: _Part) -> dict[int, int]:
        """Return how many loops tie their part to the largest, per loop that is not within it."""
        part_of = _part_of(parts)
        pairs = {
            key: {part_of[loop.ref_id], part_of[loop.query_id]} for key, loop in self._loops.items()
        }
        home = parts.index(largest)
        near = {part for pair in pairs.values() if home in pair for part in pair} - {home}
        return {key: int(bool(pair & near)) for key, pair in pairs.items() if pair != {home}}


def tied(keyframes: Sequence[Keyframe], links: Sequence[Link]) -> tuple[Keyframe, ...]:
    """Return keyframes whose T_odom_cam are those of one odometry, where links tie their segments.

    A segment that hangs on no other stays where it is.
    """
    below: dict[int, list[Link]] = defaultdict(list)
    for link in links:
        above, segment = (keyframes[k].segment for k in (link.ref_id, link.query_id))
        if above != segment:
            below[above].append(link)
    hanging = {keyframes[tie.query_id].segment for ties in below.values() for tie in ties}
    T_odom_segment = {each: np.eye(4) for each in below if each not in hanging}
    todo = list(T_odom_segment)
    for above in todo:
        for tie in below[above]:
            ref, first = keyframes[tie.ref_id], keyframes[tie.query_id]
            T_odom_first = T_odom_segment[above] @ ref.T_odom_cam @ tie.motion.T_ref_query
            T_odom_segment[first.segment] = T_odom_first @ se3.inverse(first.T_odom_cam)
            todo.append(first.segment)
    return tuple(
        replace(each, T_odom_cam=T_odom_segment[each.segment] @ each.T_odom_cam)
        if each.segment in hanging
        else each
        for each in keyframes
    )


def _part_of(parts: Sequence[_Part]) -> dict[int, int]:
    """Return the part's place in the list by keyframe id."""
    return {k: i for i, part in enumerate(parts) for k in part.T_part_kf}


def _tie(earlier: _Part, later: _Part, loops: Sequence[Link]) -> tuple[int, Link]:
    """Return where the later part begins by the loop that most agree with, and how many do.

    The loops have their reference in the earlier part.
    """
    T_later_query = later.places([loop.query_id for loop in loops])
    T_ref_query = np.array([loop.motion.T_ref_query for loop in loops])
    T_earlier_query = earlier.places([loop.ref_id for loop in loops]) @ T_ref_query
    T_earlier_later = T_earlier_query @ se3.inverse(T_later_query)
    asked = range(0, len(loops), -(-len(loops) // _HYPOTHESES))
    votes = []
    for i in asked:  # where loop i puts the query of every loop, as seen from where that puts it
        error = se3.inverse(T_earlier_query) @ T_earlier_later[i] @ T_later_query
        is_near = se3.translation_norm(error) < _AGREE_M
        votes.append(np.count_nonzero(is_near & (se3.rotation_angle(error) < _AGREE_RAD)))
    best = asked[int(np.argmax(votes))]
    T_query_first = se3.inverse(T_later_query[best]) @ later.T_part_kf[later.first]
    motion = RelativePose(T_ref_query[best] @ T_query_first, _NEXT_TO_NOTHING)
    return int(max(votes)), Link(loops[best].ref_id, later.first, motion)


def _union(earlier: _Part, later: _Part, tie: Link) -> _Part:
    T_earlier_first = earlier.T_part_kf[tie.ref_id] @ tie.motion.T_ref_query
    T_earlier_later = T_earlier_first @ se3.inverse(later.T_part_kf[later.first])
    moved = {k: T_earlier_later @ T_later_kf for k, T_later_kf in later.T_part_kf.items()}
    return _Part({**earlier.T_part_kf, **moved}, [*earlier.links, tie, *later.links])


def _reversed(loop: Link) -> Link:
    """Return a loop seen from its other end, for its motion alone."""
    motion = replace(loop.motion, T_ref_query=se3.inverse(loop.motion.T_ref_query))
    return Link(loop.query_id, loop.ref_id, motion)
