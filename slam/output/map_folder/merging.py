# SPDX-License-Identifier: Apache-2.0
"""Saved maps made one, by loops between them: found, weighed and adjusted to as those of a run."""

import hashlib
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from placerec.certificate import fingerprint
from placerec.files import Progress
from placerec.recognizer import PlaceRecognizer
from slam.config import Config
from slam.loops.back_end import BackEnd, ClosedLoops
from slam.loops.loop_closure import LoopCloser
from slam.loops.saved_map import SavedMap
from slam.loops.stage_clock import StageClock
from slam.mapping.map_adjustment import adjust_with_loops, size_warning
from slam.output.decision import Decision
from slam.output.map_folder.beside_each_other import beside_each_other, starts_of
from slam.output.map_folder.folder import line_of
from slam.types import IntArray, LoopAttempt, SlamError

_FEW_LOOPS = 5  # that join a map; fewer are told


@dataclass(frozen=True)
class Join:
    """What was found between two maps.

    Attributes:
        maps: their names.
        candidates, verified, used: how many pairs of keyframes were looked at, how many of them
            geometry verified, and how many of those are loops of the merged map.
    """

    maps: tuple[str, str]
    candidates: int
    verified: int
    used: int


@dataclass(frozen=True)
class MergedMaps:
    """Maps that loops join, as one, and what was left apart.

    Attributes:
        the_map: the merged map, in the frame of the first of those that are in it.
        sessions: the numbers of its sessions by the name of the map that they were in.
        joins: of every two maps that are in it.
        apart: by the name of a map that is not in it, a sentence that says why.
        warnings: a sentence for each thing that is doubtful.
    """

    the_map: SavedMap
    sessions: dict[str, tuple[int, ...]]
    joins: tuple[Join, ...]
    apart: dict[str, str]
    warnings: tuple[str, ...]


def merge_maps(
    maps: Mapping[str, SavedMap],
    recognizer: PlaceRecognizer,
    config: Config | None = None,
    progress: Progress | None = None,
    pairs: Collection[tuple[str, str]] | None = None,
) -> MergedMaps:
    """Join maps, which are left as they are, by loops between them.

    Keyframes of later maps are compared with those of earlier ones, verified as in a run, and
    weighed in one robust pose graph with all loops that the maps came with. Maps become one where
    loops agree at two places how they lie. What is not joined to the most frames is left apart.

    Args:
        maps: by their names, for what is told.
        recognizer: the one that embedded the places of all maps.
        config: of loops, verification and the graph; default: the default settings.
        progress: is told how many keyframes were compared.
        pairs: names of two maps each, between which alone loops are looked for; default: all.

    Raises:
        SlamError: there is one map alone, one holds all keyframes of another, one is of another
            recognizer, or no loops join any two of them.
        RecognizerError: the recognizer cannot be told from others, or failed to compare.
    """
    _check(maps, fingerprint(recognizer))
    config = config or Config()
    names, starts = list(maps), starts_of(maps.values())
    whole = beside_each_other(list(maps.values()))
    partners = None if pairs is None else _partners(names, pairs)
    back_end = _with_loops_between(whole, recognizer, config, progress, partners)
    frames = dict(enumerate(whole.frames.tolist()))
    closed = back_end.solve({k.id: k.T_odom_cam for k in whole.keyframes}, frames)
    new = closed.attempts[len(whole.attempts) :]
    map_of = np.repeat(np.arange(len(maps)), np.diff(starts))
    is_in = np.isfinite(closed.T_world_kf[starts[:-1], 0, 0])
    if not is_in.all():
        apart = {
            name: _why_apart(name, number, new, map_of)
            for number, name in enumerate(names)
            if not is_in[number]
        }
        joined = {name: each for name, each in maps.items() if name not in apart}
        if len(joined) < 2:
            raise SlamError("no loops join any two of the maps: " + "; ".join(apart.values()))
        # Once more, as if the others had never been there.
        merged = merge_maps(joined, recognizer, config, progress, pairs)
        return replace(merged, apart={**apart, **merged.apart})
    merged_map, too_many = _adjusted(back_end, whole, closed)
    joins = _joins(names, new, map_of)
    return MergedMaps(
        merged_map,
        {
            name: tuple(np.unique(whole.sessions[map_of == number]).tolist())
            for number, name in enumerate(names)
        },
        joins,
        {},
        (
            *closed.warnings,
            *too_many,
            *_dropped(closed.attempts[: len(whole.attempts)]),
            *_weakly_joined(names, joins),
        ),
    )


def _check(maps: Mapping[str, SavedMap], made_by: str) -> None:
    """Refuse what cannot be one map, or gives none that is more than what there was.

    Raises:
        SlamError: it is so.
    """
    if len(maps) < 2:
        raise SlamError("merging needs two maps at least")
    first = next(iter(maps.values()))
    for name, each in maps.items():
        if each.fingerprint != made_by or each.embeddings.shape[1:] != first.embeddings.shape[1:]:
            raise SlamError(
                "the places of this map were embedded by another recognizer, whose embeddings"
                f" cannot be compared: {name}"
            )
    taken = {name: _taken(each) for name, each in maps.items()}
    for (one, of_one), (other, of_other) in combinations(taken.items(), 2):
        for within, of_within, around, of_around in (
            (one, of_one, other, of_other),
            (other, of_other, one, of_one),
        ):
            if of_within <= of_around:
                raise SlamError(
                    f"all keyframes of {within} are in {around}, to which it has nothing to add;"
                    " leave it out"
                )


def _taken(one: SavedMap) -> set[tuple[float, bytes]]:
    """Return what tells the keyframes of a map from those of others."""
    return {
        (keyframe.timestamp_s, hashlib.sha256(embedding.tobytes()).digest())
        for keyframe, embedding in zip(one.keyframes, one.embeddings, strict=True)
    }


def _partners(names: Sequence[str], pairs: Collection[tuple[str, str]]) -> dict[int, IntArray]:
    """Return with which maps each may close loops, by their numbers."""
    either_way = {*pairs, *((other, one) for one, other in pairs)}
    return {
        number: np.flatnonzero([(name, other) in either_way for other in names])
        for number, name in enumerate(names)
    }


class _AcrossMaps(LoopCloser):
    """Looks for loops between segments alone: within each they were looked for as it was made.

    Attributes:
        partners: those that a segment may close loops with, None where these are all others.
    """

    partners: dict[int, IntArray] | None = None

    def load(self, saved: SavedMap) -> None:
        """Leave it: the keyframes come one after the other."""

    def _is_candidate(
        self, numbers: IntArray, number: int, segment: int, linked_ids: Sequence[int]
    ) -> NDArray[np.bool_]:
        segments = np.array(self._segments, np.int64)[numbers]
        if self.partners is not None:
            return np.isin(segments, self.partners[segment])
        return np.asarray(segments != segment)


def _with_loops_between(
    whole: SavedMap,
    recognizer: PlaceRecognizer,
    config: Config,
    progress: Progress | None,
    partners: dict[int, IntArray] | None,
) -> BackEnd:
    """Return maps beside each other with the loops that were found between them."""
    back_end = BackEnd(whole.camera, recognizer, config, StageClock())
    closer = _AcrossMaps(whole.camera, recognizer, config.loop, config.verification)
    closer.partners = partners
    back_end.loop_closer = closer
    back_end.load(whole, is_world=False)
    for keyframe, embedding in zip(whole.keyframes, whole.embeddings, strict=True):
        back_end.add_loops(closer.close(keyframe, embedding))
        if progress:
            progress(keyframe.id + 1, len(whole.keyframes))
    return back_end


def _adjusted(
    back_end: BackEnd, whole: SavedMap, closed: ClosedLoops
) -> tuple[SavedMap, tuple[str, ...]]:
    """Return the map where its landmarks put it in the end, and a warning if it is too large."""
    T_world_kf, final = closed.T_world_kf, whole.the_map
    if not (too_many := size_warning(len(T_world_kf))):
        loops = [(each.match_id, each.query_id) for each in closed.attempts if not each.rejection]
        final = adjust_with_loops(whole.the_map, range(len(T_world_kf)), T_world_kf, loops)
        T_world_kf = np.array([each.T_map_cam for each in final.keyframes])
    frames = dict(enumerate(whole.frames.tolist()))
    saved = back_end.saved(T_world_kf, closed.attempts, closed.links, whole.sessions, frames, final)
    threshold = back_end.loop_closer.min_similarity
    lines = [
        line_of(
            Decision(each, whole.keyframes[each.query_id], whole.keyframes[each.match_id], None),
            threshold,
        )
        for each in closed.attempts[len(whole.attempts) :]
    ]
    is_new = saved.is_new & whole.is_new
    return replace(saved, is_new=is_new, ledger=(*whole.ledger, *lines)), too_many


def _why_apart(name: str, number: int, new: Sequence[LoopAttempt], map_of: IntArray) -> str:
    tried = [each for each in new if number in map_of[[each.query_id, each.match_id]]]
    if not tried:
        return f"{name} is left apart: no keyframe of another map looks like one of it"
    verified = sum(each.motion is not None for each in tried)
    reasons = Counter(each.rejection.reason for each in tried if each.rejection)
    told = "".join(f", {count} were rejected for: {why}" for why, count in reasons.most_common(1))
    return (
        f"{name} is left apart: of {len(tried)} candidates for loops with other maps {verified}"
        f" were verified{told}"
    )


def _joins(names: Sequence[str], new: Sequence[LoopAttempt], map_of: IntArray) -> tuple[Join, ...]:
    found: dict[tuple[int, int], list[LoopAttempt]] = {
        pair: [] for pair in combinations(range(len(names)), 2)
    }
    for each in new:
        found[int(map_of[each.match_id]), int(map_of[each.query_id])].append(each)
    return tuple(
        Join(
            (names[one], names[other]),
            len(some),
            sum(each.motion is not None for each in some),
            sum(each.rejection is None for each in some),
        )
        for (one, other), some in found.items()
    )


def _dropped(before: Sequence[LoopAttempt]) -> tuple[str, ...]:
    count = sum(each.rejection is not None for each in before)
    if not count:
        return ()
    return (
        f"{count} of the {len(before)} loops that the maps came with are not in use any more: the"
        " loops between them contradict those",
    )


def _weakly_joined(names: Sequence[str], joins: Sequence[Join]) -> tuple[str, ...]:
    loops = {name: sum(each.used for each in joins if name in each.maps) for name in names}
    return tuple(
        f"{name} is joined by {count} loops alone: look whether it lies where it belongs"
        for name, count in loops.items()
        if count < _FEW_LOOPS
    )
