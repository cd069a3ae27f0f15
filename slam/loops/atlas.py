# SPDX-License-Identifier: Apache-2.0
"""The whole map: segments, and the submaps that loops join them to."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slam.external_odometry.comparison import GivenKeyframe
from slam.external_odometry.trust import Trust, Verdict, judge
from slam.geometry import se3
from slam.loops.correction import Correction
from slam.loops.saved_map import SavedMap
from slam.loops.submaps import Loop, Submap, joined, joined_by_steps, submap_of
from slam.pose_graph import GraphSolution, PoseGraph
from slam.types import FloatArray, Keyframe, Link, LoopAttempt, RelativePose


@dataclass(frozen=True)
class LargestSubmap:
    """The part of the map with the most frames, ready to be solved.

    Attributes:
        graph: its keyframes, links and loops.
        unjoined: per key of a loop in or to another submap, at how many places loops join that.
        T_odom_kf: (4, 4) by keyframe id, what the odometry had made of its keyframes then.
        segment_of: by keyframe id.
        trust: what the images say of an odometry from elsewhere, None where there is none.
        T_given_kf: (4, 4) by keyframe id, where that has its keyframes.
    """

    graph: PoseGraph
    unjoined: dict[int, int]
    T_odom_kf: dict[int, FloatArray]
    segment_of: dict[int, int]
    trust: Trust | None
    T_given_kf: dict[int, FloatArray]

    def correction(self, before: Correction, newest_id: int, solution: GraphSolution) -> Correction:
        """Return what a solution of the graph says of the odometry, after the one before."""
        newest_of = {self.segment_of[k]: k for k in sorted(solution.T_world_kf)}
        T_world_odom = {
            segment: solution.T_world_kf[k] @ se3.inverse(self.T_odom_kf[k])
            for segment, k in newest_of.items()
        }
        T_world_given = None
        if self.trust and self.trust.is_followed and self.T_given_kf:
            # Before anything can be said of it, and no loop was closed, it stays as it begins.
            is_untried = self.trust.verdict is Verdict.UNKNOWN and not self.graph.loops
            k = (min if is_untried else max)(self.T_given_kf)
            T_world_given = solution.T_world_kf[k] @ se3.inverse(self.T_given_kf[k])
        version, T_world_kf = before.version + 1, solution.T_world_kf
        found = Correction(version, newest_id, T_world_kf, T_world_odom, T_world_given)
        return found.after(before, self.T_given_kf)


class Atlas:
    """Keyframes and motions, sorted into submaps that motions connect.

    Links say how well the odometry knows the motion between two keyframes; what that motion is,
    follows from where the odometry has them now. So the graph never contradicts the map. Segments
    that loops join get one graph together, in which the loops between them are doubted as any other
    loop is.

    Attributes:
        loops: how many loops there are, per segment of their later keyframe.
    """

    def __init__(self) -> None:
        self._keyframes: list[Keyframe] = []
        self._T_odom_kf: list[FloatArray] = []
        self._links: list[Link] = []
        self._loops: dict[int, Loop] = {}
        self._given: dict[int, GivenKeyframe] = {}
        self.loops: Counter[int] = Counter()
        self._home = -1  # a keyframe of the earlier map that this one goes on from, if any

    def load(self, saved: SavedMap, is_world: bool = True) -> None:
        """Begin with an earlier map, its loops by number; default: it stays the world."""
        self._keyframes = list(saved.keyframes)
        self._T_odom_kf = [each.T_odom_cam for each in saved.keyframes]
        self._links = list(saved.links)
        self._loops = dict(enumerate(saved.loops))
        self.loops.update(saved.keyframes[each.query_id].segment for each in saved.loops)
        self._home = saved.keyframes[0].id if is_world else -1

    def add(
        self, keyframe: Keyframe, links: Sequence[Link], attempts: Mapping[int, LoopAttempt]
    ) -> None:
        """Add the next keyframe, its links to others of its segment, and its loops by key."""
        self._keyframes.append(keyframe)
        self._T_odom_kf.append(keyframe.T_odom_cam)
        self._links.extend(links)
        self.add_loops(attempts)

    def add_loops(self, attempts: Mapping[int, LoopAttempt]) -> None:
        """Add loops by key, between keyframes that are in the map."""
        for key, attempt in attempts.items():
            if isinstance(attempt.outcome, RelativePose) and (seen := attempt.verification):
                points_ref_m = seen.points_ref_m[seen.inlier_mask].astype(np.float64)
                loop = Loop.of(attempt.match_id, attempt.query_id, attempt.outcome, points_ref_m)
                self._loops[key] = loop
                self.loops[self._keyframes[attempt.query_id].segment] += 1

    def loop(self, key: int) -> Loop:
        """Return a loop by its key."""
        return self._loops[key]

    def give(self, given: Mapping[int, GivenKeyframe]) -> None:
        """Take where an odometry from elsewhere has keyframes, by id."""
        self._given.update(given)

    def forget_given(self) -> None:
        """Forget all that an odometry from elsewhere said."""
        self._given.clear()

    def move(self, T_odom_kf: Mapping[int, FloatArray]) -> None:
        """Take (4, 4) poses by keyframe id for where the odometry has these keyframes now."""
        for k, T in T_odom_kf.items():
            self._T_odom_kf[k] = T

    def largest(
        self, frames: Mapping[int, int] | None = None, with_given: bool = True
    ) -> LargestSubmap:
        """Return the submap with the most frames per keyframe id, the earlier of equals.

        Default: one frame of each. An earlier map is it, however small. An odometry from elsewhere
        may be left out.
        """
        trust = self._trust() if with_given else None
        steps = trust.steps if trust else ()
        submaps = self._submaps(steps)
        largest = max(submaps, key=lambda each: (self._home in each.T_submap_kf, each.size(frames)))
        T_world_submap = se3.inverse(largest.T_submap_kf[largest.first])
        loops = {
            key: loop
            for key, loop in self._loops.items()
            if loop.ref_id in largest.T_submap_kf and loop.query_id in largest.T_submap_kf
        }
        inside = largest.T_submap_kf
        T_world_kf = T_world_submap @ np.array(list(inside.values()))
        graph = PoseGraph(
            dict(zip(inside, T_world_kf, strict=True)),
            tuple(largest.links),
            shared_out(loops),
            tuple(each for each in steps if each.ref_id in inside and each.query_id in inside),
        )
        return LargestSubmap(
            graph,
            self._unjoined(submaps, largest),
            {k: self._T_odom_kf[k] for k in inside},
            {k: self._keyframes[k].segment for k in inside},
            trust,
            {k: each.T_given_cam for k, each in self._given.items() if k in inside},
        )

    def _trust(self) -> Trust | None:
        if not self._given:
            return None
        stamps_s = {each.id: each.timestamp_s for each in self._keyframes}
        return judge([*self._links, *self._loops.values()], self._given, stamps_s)

    def _submaps(self, steps: Sequence[Link]) -> list[Submap]:
        submaps: dict[int, Submap] = {}
        T_odom_kf = np.array(self._T_odom_kf).reshape(-1, 4, 4)
        for keyframe, T in zip(self._keyframes, T_odom_kf, strict=True):
            submap = submaps.setdefault(keyframe.segment, Submap({}, []))
            submap.T_submap_kf[keyframe.id] = T
        ends = np.array([(link.ref_id, link.query_id) for link in self._links], np.int64)
        ref, query = ends.reshape(-1, 2).T
        T_ref_query = se3.inverse(T_odom_kf[ref]) @ T_odom_kf[query]
        for link, T in zip(self._links, T_ref_query, strict=True):
            motion = RelativePose(T, link.motion.information)
            segment = self._keyframes[link.ref_id].segment
            submaps[segment].links.append(Link(link.ref_id, link.query_id, motion))
        return joined(joined_by_steps(list(submaps.values()), steps), self._loops.values())

    def _unjoined(self, submaps: Sequence[Submap], largest: Submap) -> dict[int, int]:
        """Return per loop not within the largest at how many places its submap is tied to that."""
        if len(submaps) == 1:
            return {}
        number_of = submap_of(submaps)
        pairs = {
            key: {number_of[loop.ref_id], number_of[loop.query_id]}
            for key, loop in self._loops.items()
        }
        home = submaps.index(largest)
        near = {submap for pair in pairs.values() if home in pair for submap in pair} - {home}
        return {key: int(bool(pair & near)) for key, pair in pairs.items() if pair != {home}}


def shared_out(loops: Mapping[int, Link]) -> dict[int, Link]:
    """Return the loops with as much information per query as one of them has.

    What bends the query's image is in all of its loops: they repeat its error, not correct it.
    """
    count = Counter(loop.query_id for loop in loops.values())
    shared = {}
    for key, loop in loops.items():
        information = loop.motion.information / count[loop.query_id]
        motion = RelativePose(loop.motion.T_ref_query, information)
        shared[key] = Link(loop.ref_id, loop.query_id, motion)
    return shared


def odometry_frames(keyframes: Sequence[Keyframe], links: Sequence[Link]) -> dict[int, FloatArray]:
    """Return (4, 4) T_odom_segment by segment: all odometries as one, where links join segments.

    A segment that no link leads to stays where it is.
    """
    below: dict[int, list[Link]] = defaultdict(list)
    for link in links:
        above, segment = (keyframes[k].segment for k in (link.ref_id, link.query_id))
        if above != segment:
            below[above].append(link)
    not_first = {keyframes[join.query_id].segment for joins in below.values() for join in joins}
    T_odom_segment = {each.segment: np.eye(4) for each in keyframes}
    todo = [each for each in below if each not in not_first]
    for above in todo:
        for join in below[above]:
            ref, first = keyframes[join.ref_id], keyframes[join.query_id]
            T_odom_first = T_odom_segment[above] @ ref.T_odom_cam @ join.motion.T_ref_query
            T_odom_segment[first.segment] = T_odom_first @ se3.inverse(first.T_odom_cam)
            todo.append(first.segment)
    return T_odom_segment
