# SPDX-License-Identifier: Apache-2.0
"""Parts of the map, and how loops between them say that they lie."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.geometry import se3
from slam.types import FloatArray, Link, Rejection, RejectionReason, RelativePose

NEEDED_PLACES = 2
"""Places at which loops have to agree how two submaps lie before the two become one.

Two loops are at two places if they share neither keyframe, and what the one's views have in common
lies apart from what the other's have: its middle is further away than both reach together. For all
loops that a poster and its twin make agree, wherever the camera stands.
"""

# Two loops agree where one puts the other's keyframe no further than this from where that does. Of
# 659 motions verified between all keyframes of fr1_xyz and fr1_desk 5 were off by more, none by
# more than 14 cm or 7 degrees: those were blurred views, not other places.
_AGREE_M, _AGREE_RAD = 0.10, np.radians(5.0)
_HYPOTHESES = 200  # of more loops between two submaps so many are tried, and all of them vote
# A step of another odometry joins two submaps alone where it is known better than this.
_CERTAIN_M, _CERTAIN_RAD = 0.3, np.radians(15.0)
_NEXT_TO_NOTHING = np.eye(6)  # of information: 1 rad, 1 m


@dataclass(frozen=True, eq=False)
class Loop(Link):
    """A verified loop, and which place it saw.

    Attributes:
        centre_ref_m: (3,) middle of what both views show, metres, reference camera frame.
        radius_m: how far that reaches: the root mean square distance of its points from there.
    """

    centre_ref_m: FloatArray
    radius_m: float

    @staticmethod
    def of(match_id: int, query_id: int, motion: RelativePose, points_ref_m: FloatArray) -> "Loop":
        """Return the loop that (N, 3) points agree with, metres, reference camera frame."""
        centre_m = points_ref_m.mean(axis=0)
        radius_m = float(np.sqrt(((points_ref_m - centre_m) ** 2).sum(axis=1).mean()))
        return Loop(match_id, query_id, motion, centre_m, radius_m)

    @property
    def reversed(self) -> "Loop":
        """The same with the query for reference; only its motion is right, not its information."""
        T_query_ref = se3.inverse(self.motion.T_ref_query)
        motion = replace(self.motion, T_ref_query=T_query_ref)
        (centre_m,) = se3.transform(T_query_ref, self.centre_ref_m[None])
        return Loop(self.query_id, self.ref_id, motion, centre_m, self.radius_m)


@dataclass(frozen=True, eq=False)
class Submap:
    """Keyframes that motions connect.

    Attributes:
        T_submap_kf: (4, 4) by keyframe id, by odometry and joins alone; the first comes first.
        links: each leads to a keyframe from one before it, or is one more between such.
    """

    T_submap_kf: dict[int, FloatArray]
    links: list[Link]

    @property
    def first(self) -> int:
        """The keyframe that came first."""
        return next(iter(self.T_submap_kf))

    def size(self, frames: Mapping[int, int] | None) -> int:
        """Return how many frames it has, given how many there are per keyframe id; default: one."""
        return sum(1 if frames is None else frames.get(k, 0) for k in self.T_submap_kf)

    def places(self, keyframe_ids: Iterable[int]) -> FloatArray:
        """Return (N, 4, 4), where keyframes are in it."""
        return np.array([self.T_submap_kf[k] for k in keyframe_ids])


def submap_of(submaps: Sequence[Submap]) -> dict[int, int]:
    """Return the submap's number in the list by keyframe id."""
    return {k: i for i, submap in enumerate(submaps) for k in submap.T_submap_kf}


def joined(submaps: Sequence[Submap], loops: Iterable[Loop]) -> list[Submap]:
    """Join submaps where loops agree at two places, one pair after the other, the clearest first.

    So a false loop that came early has no say against those that came later. What joins two submaps
    has next to no information: it tells a solver where to start, and the loops decide.
    """
    submaps, loops = list(submaps), list(loops)
    while len(submaps) > 1:
        between = _between(submaps, loops)
        joins = [(*_join(submaps[i], submaps[j], some), i, j) for (i, j), some in between.items()]
        votes, join, i, j = max(joins, key=lambda each: each[0], default=(0, None, 0, 0))
        if join is None or votes < NEEDED_PLACES:
            break
        submaps[i] = _union(submaps[i], submaps.pop(j), join)
    return submaps


def align_maps(
    T_a_kf: Mapping[int, FloatArray], T_b_kf: Mapping[int, FloatArray], loops: Iterable[Loop]
) -> FloatArray | Rejection:
    """Return the (4, 4) T_a_b between two maps where loops at two places agree how they lie.

    It is the mean by all that agree with the loop that most agree with. The number in the rejection
    is at how many places loops agree.

    Args:
        T_a_kf: (4, 4) by keyframe id, where map a has its keyframes.
        T_b_kf: the same of map b, which numbers its own.
        loops: have their reference in map a and their query in map b; those of keyframes without a
            place are left out.
    """
    placed = [each for each in loops if each.ref_id in T_a_kf and each.query_id in T_b_kf]
    if not placed:
        return Rejection(RejectionReason.UNJOINED, 0, NEEDED_PLACES)
    vote = _vote(Submap(dict(T_a_kf), []), Submap(dict(T_b_kf), []), placed)
    if not vote.agrees.any():
        return Rejection(RejectionReason.UNJOINED, 1, NEEDED_PLACES)
    return se3.mean_motion(vote.T_b_query[vote.agrees], vote.T_a_query[vote.agrees])


def joined_by_steps(submaps: Sequence[Submap], steps: Iterable[Link]) -> list[Submap]:
    """Join submaps that an odometry from elsewhere went between, while the images showed nothing.

    Steps that are too uncertain leave it to the loops. What joins has next to no information: the
    step itself is a motion of the graph.
    """
    submaps = list(submaps)
    for step in steps:
        number_of = submap_of(submaps)
        i, j = number_of[step.ref_id], number_of[step.query_id]
        if i == j or not _is_certain(step):
            continue
        a, b, T_a_b = step.ref_id, step.query_id, step.motion.T_ref_query
        if j < i:
            i, j, a, b, T_a_b = j, i, b, a, se3.inverse(T_a_b)
        later = submaps.pop(j)
        T_a_first = T_a_b @ se3.inverse(later.T_submap_kf[b]) @ later.T_submap_kf[later.first]
        join = Link(a, later.first, RelativePose(T_a_first, _NEXT_TO_NOTHING))
        submaps[i] = _union(submaps[i], later, join)
    return submaps


def _is_certain(step: Link) -> bool:
    variance = np.diag(np.linalg.inv(step.motion.information))
    return bool(variance[:3].max() < _CERTAIN_RAD**2 and variance[3:].max() < _CERTAIN_M**2)


def _between(submaps: Sequence[Submap], loops: Iterable[Loop]) -> dict[tuple[int, int], list[Loop]]:
    """Return the loops between any two submaps, all from the earlier, for their motions alone."""
    number_of = submap_of(submaps)
    between: dict[tuple[int, int], list[Loop]] = defaultdict(list)
    for loop in loops:
        i, j = number_of[loop.ref_id], number_of[loop.query_id]
        if i < j:
            between[i, j].append(loop)
        elif j < i:
            between[j, i].append(loop.reversed)
    return between


@dataclass(frozen=True, eq=False)
class _Vote:
    """Which of N loops between two maps agree with the one that most agree with.

    Attributes:
        best: its number.
        agrees: (N,) bool, none where no loop has another at another place that agrees with it.
        T_a_query, T_b_query: (N, 4, 4), where the loops put the query in one map, and where the
            other has it.
    """

    best: int
    agrees: NDArray[np.bool_]
    T_a_query: FloatArray
    T_b_query: FloatArray


def _vote(a: Submap, b: Submap, loops: Sequence[Loop]) -> _Vote:
    """Let loops vote how two maps lie; they have their reference in a and their query in b."""
    T_b_query = b.places(loop.query_id for loop in loops)
    T_ref_query = np.array([loop.motion.T_ref_query for loop in loops])
    T_a_ref = a.places(loop.ref_id for loop in loops)
    T_a_query = T_a_ref @ T_ref_query
    T_a_b = T_a_query @ se3.inverse(T_b_query)
    # Loops that agree put in map b what each shows where they put it in map a: what is apart on one
    # side is apart on the other.
    centre_ref_m = np.array([loop.centre_ref_m for loop in loops])
    centre_m = np.einsum("nij,nj->ni", T_a_ref[:, :3, :3], centre_ref_m)
    centre_m += T_a_ref[:, :3, 3]
    radius_m = np.array([loop.radius_m for loop in loops])
    ids = np.array([(loop.ref_id, loop.query_id) for loop in loops])
    best, most = 0, np.zeros(len(loops), bool)
    for i in range(0, len(loops), -(-len(loops) // _HYPOTHESES)):
        # where loop i puts the query of every loop, as seen from where that puts it
        error = se3.inverse(T_a_query) @ T_a_b[i] @ T_b_query
        agrees = (se3.translation_norm(error) < _AGREE_M) & (se3.rotation_angle(error) < _AGREE_RAD)
        is_apart = np.linalg.norm(centre_m - centre_m[i], axis=1) > radius_m + radius_m[i]
        is_elsewhere = is_apart & (ids != ids[i]).all(axis=1)
        if (agrees & is_elsewhere).any() and np.count_nonzero(agrees) > np.count_nonzero(most):
            best, most = i, agrees
    return _Vote(best, most, T_a_query, T_b_query)


def _join(earlier: Submap, later: Submap, loops: Sequence[Loop]) -> tuple[int, Link]:
    """Return how many loops agree on where the later submap lies, and the join by one of them.

    The loops have their reference in the earlier submap; the join leads to the later one's first.
    """
    vote = _vote(earlier, later, loops)
    best = loops[vote.best]
    T_query_first = se3.inverse(vote.T_b_query[vote.best]) @ later.T_submap_kf[later.first]
    motion = RelativePose(best.motion.T_ref_query @ T_query_first, _NEXT_TO_NOTHING)
    return int(np.count_nonzero(vote.agrees)), Link(best.ref_id, later.first, motion)


def _union(earlier: Submap, later: Submap, join: Link) -> Submap:
    T_earlier_first = earlier.T_submap_kf[join.ref_id] @ join.motion.T_ref_query
    T_earlier_later = T_earlier_first @ se3.inverse(later.T_submap_kf[later.first])
    moved = {k: T_earlier_later @ T_later_kf for k, T_later_kf in later.T_submap_kf.items()}
    return Submap({**earlier.T_submap_kf, **moved}, [*earlier.links, join, *later.links])
