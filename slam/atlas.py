# SPDX-License-Identifier: Apache-2.0
"""The parts of the map, each a pose graph of its own until loops agree how two of them lie."""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from slam import se3
from slam.config import GraphConfig
from slam.pose_graph import PoseGraph
from slam.types import FloatArray, Keyframe, Link, LoopAttempt, RelativePose

NEEDED_LOOPS = 2
"""Loops that have to agree on how two parts lie to each other before the two become one."""

# Two loops agree where one puts the other's keyframes no further apart than this from where the
# other does.
_AGREE_M, _AGREE_RAD = 0.10, np.radians(5.0)
_AGREEMENT = np.diag([_AGREE_RAD**-2.0] * 3 + [_AGREE_M**-2.0] * 3)


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


@dataclass(eq=False)
class _Part:
    """Keyframes that hang together; the first of them is the part's origin."""

    graph: PoseGraph
    keyframe_ids: list[int] = field(default_factory=list)
    links: list[Link] = field(default_factory=list)
    loops: dict[int, Link] = field(default_factory=dict)

    def add_keyframe(self, keyframe_id: int, T_part_kf: FloatArray) -> None:
        self.graph.add_keyframe(keyframe_id, T_part_kf)
        self.keyframe_ids.append(keyframe_id)

    def add_link(self, link: Link) -> None:
        self.graph.add_link(link)
        self.links.append(link)

    def add_loop(self, key: int, loop: Link) -> None:
        self.graph.add_loop(key, loop.ref_id, loop.query_id, loop.motion)
        self.loops[key] = loop

    def T_part_kf(self, keyframe_ids: Sequence[int]) -> FloatArray:
        return np.array([self.graph.T_world_kf(each) for each in keyframe_ids])


class Atlas:
    """Keyframes and motions, sorted into parts of the map that hang together.

    Every segment begins as a part. Verified loops between two parts wait until enough of them
    agree; then the parts are tied by a motion that is worth no more than this agreement, and all
    loops between them have to prove themselves in the graph as any other loop has to. So the tie
    does not decide where the parts lie, and a wrong one can be outvoted.
    """

    def __init__(self, config: GraphConfig) -> None:
        self._config = config
        self._part_of_segment: dict[int, _Part] = {}
        self._part_of: list[_Part] = []  # by keyframe id
        self._waiting: dict[int, Link] = {}  # the loops between parts

    def add(
        self, keyframe: Keyframe, links: Sequence[Link], attempts: Mapping[int, LoopAttempt]
    ) -> None:
        """Add the next keyframe, its motions to others of its segment, and its loops by key."""
        if keyframe.segment not in self._part_of_segment:
            self._part_of_segment[keyframe.segment] = _Part(PoseGraph(self._config))
        part = self._part_of_segment[keyframe.segment]
        T_part_kf = np.eye(4)
        if links:
            T_part_kf = part.graph.T_world_kf(links[0].ref_id) @ links[0].motion.T_ref_query
        part.add_keyframe(keyframe.id, T_part_kf)
        self._part_of.append(part)
        for link in links:
            part.add_link(link)
        for key, attempt in attempts.items():
            if isinstance(attempt.outcome, RelativePose):
                loop = Link(attempt.match_id, attempt.query_id, attempt.outcome)
                self._waiting[key] = loop
        self._settle(part)
        while self._join_two():
            pass

    def finish(self, frames: Mapping[int, int]) -> AtlasSolution:
        """Solve the part with the most frames, the earlier of equals; frames are per keyframe."""
        parts = list(dict.fromkeys(self._part_of)) or [_Part(PoseGraph(self._config))]
        sizes = [sum(frames.get(k, 0) for k in part.keyframe_ids) for part in parts]
        largest = parts[int(np.argmax(sizes))]
        solution = largest.graph.finish()
        T_world_kf = np.full((len(self._part_of), 4, 4), np.nan)
        T_world_kf[largest.keyframe_ids] = solution.T_world_kf
        unjoined = self._unjoined(largest)
        links = tuple(largest.links)
        return AtlasSolution(T_world_kf, solution.weights, links, unjoined, solution.warnings)

    def _settle(self, part: _Part) -> None:
        """Give a part the waiting loops that lie within it, and bring its poses up to date."""
        for key, loop in list(self._waiting.items()):
            if self._part_of[loop.ref_id] is self._part_of[loop.query_id] is part:
                part.add_loop(key, self._waiting.pop(key))
        part.graph.update()

    def _join_two(self) -> bool:
        """Make one part of the first two whose loops agree; return whether there are such."""
        between: dict[tuple[int, int], list[Link]] = defaultdict(list)
        for loop in self._waiting.values():
            first, second = (self._part_of[k].keyframe_ids[0] for k in (loop.ref_id, loop.query_id))
            if first < second:
                between[first, second].append(loop)
            else:
                between[second, first].append(_reversed(loop))
        for (first, second), loops in between.items():
            earlier, later = self._part_of[first], self._part_of[second]
            tie = _tie(earlier, later, loops)
            if tie is not None:
                self._absorb(earlier, later, tie)
                return True
        return False

    def _absorb(self, earlier: _Part, later: _Part, tie: Link) -> None:
        T_earlier_first = earlier.graph.T_world_kf(tie.ref_id) @ tie.motion.T_ref_query
        T_earlier_later = T_earlier_first @ se3.inverse(later.graph.T_world_kf(tie.query_id))
        for keyframe_id in later.keyframe_ids:
            T_later_kf = later.graph.T_world_kf(keyframe_id)
            earlier.add_keyframe(keyframe_id, T_earlier_later @ T_later_kf)
            self._part_of[keyframe_id] = earlier
        for link in (tie, *later.links):
            earlier.add_link(link)
        for key, loop in later.loops.items():
            earlier.add_loop(key, loop)
        for segment, part in self._part_of_segment.items():
            if part is later:
                self._part_of_segment[segment] = earlier
        self._settle(earlier)

    def _unjoined(self, largest: _Part) -> dict[int, int]:
        """Return the loops that are of no use to a part, and how many lead from theirs to it."""
        ends = [
            (self._part_of[loop.ref_id], self._part_of[loop.query_id])
            for loop in self._waiting.values()
        ]
        near = {part for pair in ends if largest in pair for part in pair} - {largest}
        alone = {
            key: int(bool(near.intersection(pair)))
            for key, pair in zip(self._waiting, ends, strict=True)
        }
        for part in set(self._part_of) - {largest}:
            alone |= dict.fromkeys(part.loops, int(part in near))
        return alone


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


def _tie(earlier: _Part, later: _Part, loops: Sequence[Link]) -> Link | None:
    """Return where the later part begins by the loop that most others agree with, if enough do.

    The loops have their reference in the earlier part.
    """
    T_earlier_ref = earlier.T_part_kf([loop.ref_id for loop in loops])
    T_later_query = later.T_part_kf([loop.query_id for loop in loops])
    T_ref_query = np.array([loop.motion.T_ref_query for loop in loops])
    T_earlier_query = T_earlier_ref @ T_ref_query
    T_earlier_later = T_earlier_query @ se3.inverse(T_later_query)
    # Row i, column j: where loop i puts the query of loop j, as seen from where j itself puts it.
    error = se3.inverse(T_earlier_query) @ (T_earlier_later[:, None] @ T_later_query)
    agrees = (se3.translation_norm(error) < _AGREE_M) & (se3.rotation_angle(error) < _AGREE_RAD)
    votes = agrees.sum(axis=1)
    best = int(np.argmax(votes))
    if votes[best] < NEEDED_LOOPS:
        return None
    first = later.keyframe_ids[0]
    T_query_first = se3.inverse(T_later_query[best]) @ later.graph.T_world_kf(first)
    motion = RelativePose(T_ref_query[best] @ T_query_first, _AGREEMENT)
    return Link(loops[best].ref_id, first, motion)


def _reversed(loop: Link) -> Link:
    """Return a loop seen from its other end, for its motion alone."""
    motion = replace(loop.motion, T_ref_query=se3.inverse(loop.motion.T_ref_query))
    return Link(loop.query_id, loop.ref_id, motion)
