# SPDX-License-Identifier: Apache-2.0
"""Finds the earlier keyframes that show the same place, and accounts for every candidate."""

from array import array
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from placerec.certificate import certificate_of, fingerprint
from placerec.checked_recognizer import COSINES, CheckedRecognizer
from placerec.places.index import PlaceIndex
from placerec.recognizer import PlaceRecognizer
from slam.config import LoopConfig, VerificationConfig
from slam.loops.candidates.adaptive_threshold import AdaptiveThreshold
from slam.loops.candidates.known_distances import KnownDistances
from slam.loops.candidates.novelty import Novelty
from slam.loops.candidates.second_look import SecondLook
from slam.loops.remembered import Remembered
from slam.loops.saved_map import SavedMap
from slam.loops.verification import verified
from slam.mapping.landmark_map import LandmarkMap
from slam.result import Calibration, ThresholdFit, compared
from slam.types import (
    Camera,
    Check,
    IntArray,
    Keyframe,
    LoopAttempt,
    Proposal,
    RejectionReason,
)

MOST_REMEMBERED = 500
"""Keyframes of a run of which it is kept what deciding again takes, some 70 kB each."""
_MOST_MET = 400
"""Of many more places every n-th shows as well how alike different ones are."""


class LoopCloser:
    """Retrieve by similarity, look again, verify by geometry; no candidate goes unrecorded.

    Attributes:
        min_similarity: from which candidates are verified now.
        certificate: what the recognizer was calibrated on, None where nobody says so.
    """

    def __init__(
        self,
        camera: Camera,
        recognizer: PlaceRecognizer,
        loop_config: LoopConfig,
        verification_config: VerificationConfig,
    ) -> None:
        self._camera = camera
        self._recognizer = CheckedRecognizer(recognizer, limit_s=loop_config.recognizer_limit_s)
        self._unchecked = recognizer
        self.certificate = certificate_of(recognizer)
        self._loop_config = loop_config
        self._verification_config = verification_config
        self._keyframes: list[Keyframe] = []
        self._segments = array("q")  # of each keyframe
        self._linked_ids: list[Sequence[int]] = []  # to each keyframe
        self._index = PlaceIndex(self._recognizer.comparer)
        self._places = array("q")  # the keyframe behind each entry of the index
        # Where the recognizer compares by itself, what it compares with may have to be complete.
        is_free = self._recognizer.comparer is COSINES
        self._novelty = Novelty(camera) if is_free else None
        self._shown: dict[int, NDArray[np.float32]] = {}  # embeddings of the `compared` keyframes
        self._embeddings: list[NDArray[np.float32]] = []  # of each keyframe
        self._second_look = SecondLook(camera, self._recognizer, loop_config.candidates)
        chosen = loop_config.min_similarity
        own = self._recognizer.min_similarity
        self.min_similarity = chosen if isinstance(chosen, float) else own
        self._is_adapted = chosen == "adapted"
        # Where sequences are compared, neighbours in time are alike for what they share.
        is_blind = self._recognizer.looks_back > 0
        self._adaptive = None if is_blind else AdaptiveThreshold(self.min_similarity)
        self._known = KnownDistances()

    def load(self, saved: SavedMap) -> None:
        """Begin with the keyframes of an earlier map; nothing else was added yet."""
        count = len(saved.keyframes)
        self._keyframes = list(saved.keyframes)
        self._segments = array("q", [each.segment for each in saved.keyframes])
        linked: list[list[int]] = [[] for _ in saved.keyframes]
        for link in saved.links:
            linked[max(link.ref_id, link.query_id)].append(min(link.ref_id, link.query_id))
        self._linked_ids = [*linked]
        self._embeddings = list(saved.embeddings)
        places = np.arange(count) if self._novelty is None else self._novelty.load(saved.is_new)
        self._places = array("q", places.tolist())
        for k in self._places:
            self._index.add(saved.embeddings[k])
        if self._novelty is not None:
            self._shown = {k: saved.embeddings[k] for k in compared(count)}
        self._known.skip(count)

    def describe(self, rgb: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the float32 embedding of a (H, W, 3) RGB image.

        Raises:
            RecognizerError: the recognizer returned something that is not an embedding.
        """
        return self._recognizer.embed(rgb)

    def close(
        self, keyframe: Keyframe, embedding: NDArray[np.float32], linked_ids: Sequence[int] = ()
    ) -> tuple[LoopAttempt, ...]:
        """Remember a keyframe and return what became of every earlier one that resembles it.

        The motions from keyframes with linked_ids are known already: a camera that stood still
        closes no loop with what it saw before, however long ago that was. Of another segment every
        keyframe is a candidate, for nothing else tells where that lies.

        Raises:
            RecognizerError: the recognizer compares its embeddings itself, and failed.
        """
        number = len(self._keyframes)
        places = np.array(self._places, np.int64)
        is_candidate = self._is_candidate(places, number, keyframe.segment, linked_ids)
        wanted = max(self._loop_config.second_look, self._loop_config.candidates)
        ids, similarities = self._index.query(embedding, wanted, is_candidate)
        # The best of those that are not similar enough answers "why was there no loop?".
        count = max(1, int(np.count_nonzero(similarities >= self.min_similarity)))
        matches = [self._keyframes[match_id] for match_id in places[ids[:count]]]
        attempts = self._look_again(keyframe, matches, similarities[:count])
        self._adapt(keyframe, embedding, is_candidate)
        self._keyframes.append(keyframe)
        self._segments.append(keyframe.segment)
        self._embeddings.append(embedding)
        self._linked_ids.append(tuple(linked_ids))
        self._remember(keyframe, embedding, attempts)
        return attempts

    def _remember(
        self,
        keyframe: Keyframe,
        embedding: NDArray[np.float32],
        attempts: Sequence[LoopAttempt],
    ) -> None:
        """Add a keyframe to the index, unless it shows nothing new of a place in a large map."""
        if self._novelty is None:
            self._places.append(keyframe.id)
            self._index.add(embedding)
            return
        shown = compared(len(self._keyframes))
        if keyframe.id in shown:
            self._shown[keyframe.id] = embedding
        if len(self._shown) > len(shown):
            self._shown = {k: each for k, each in self._shown.items() if k in shown}
        if self._novelty.is_new(keyframe, attempts):
            self._places.append(keyframe.id)
            self._index.add(embedding)
        if (kept := self._novelty.chosen()) is not None:
            chosen = np.isin(np.array(self._places), kept)
            self._places = array("q", np.array(self._places, np.int64)[chosen].tolist())
            self._index = self._index.select(np.flatnonzero(chosen))

    def most_similar(
        self, embedding: NDArray[np.float32], but_segment: int | None = None
    ) -> list[int]:
        """Return the keyframes, however new, that are similar enough to be verified, best first.

        Those of but_segment are left out.

        Raises:
            RecognizerError: the recognizer compares its embeddings itself, and failed.
        """
        places = np.array(self._places, np.int64)
        segments = np.array(self._segments, np.int64)[places]
        is_other = np.ones(len(segments), bool) if but_segment is None else segments != but_segment
        ids, similarities = self._index.query(embedding, self._loop_config.candidates, is_other)
        return [int(k) for k in places[ids[similarities >= self.min_similarity]]]

    def remembered(self, the_map: LandmarkMap) -> Remembered | None:
        """Return what looking for loops again takes, with the map of all keyframes.

        There is none of more than `MOST_REMEMBERED` keyframes, nor where the recognizer would have
        to be asked again: it compares by itself, or has a second look of its own.
        """
        count = len(self._keyframes)
        is_free = self._recognizer.comparer is COSINES and not self._recognizer.can_rerank
        if not is_free or not 0 < count == len(the_map.keyframes) or count > MOST_REMEMBERED:
            return None
        own = self._recognizer.min_similarity
        return Remembered(own, np.stack(self._embeddings), the_map)

    @property
    def fingerprint(self) -> str:
        """What tells whether embeddings can be compared with those of another run.

        Raises:
            RecognizerError: the recognizer has none, and no source file.
        """
        return fingerprint(self._unchecked)

    @property
    def embeddings(self) -> NDArray[np.float32]:
        """(K, *S) float32, of each keyframe."""
        return np.stack(self._embeddings)

    def is_new(self, keyframe_ids: IntArray) -> NDArray[np.bool_]:
        """Return (N,) whether keyframes showed something new when they came."""
        if self._novelty is None:
            return np.ones(len(keyframe_ids), bool)
        return np.isin(keyframe_ids, self._novelty.kept)

    def similarities(self) -> NDArray[np.float32]:
        """Return (N, N), how alike the `compared` keyframes are, -1 to 1."""
        shown = compared(len(self._keyframes))
        if self._novelty is None or not shown:
            return self._index.similarities(shown.step)
        embeddings = np.stack([self._shown[k] for k in shown])
        return COSINES.compare(embeddings, embeddings)

    def calibration(self, similarities: NDArray[np.float32]) -> Calibration | None:
        """Return where the recognizer's threshold comes from and what it met, None if unknown.

        What it met are the `similarities` of now.
        """
        if self.certificate is None:
            return None
        pairs, shown = [np.empty(0, np.float32)], compared(len(self._keyframes))
        for k, row in zip(shown, similarities, strict=True):
            before = np.arange(0, k, shown.step)
            looked_at = self.candidates(k)[before]
            pairs.append(row[: len(looked_at)][looked_at])
        return Calibration(self.certificate, np.concatenate(pairs), shown.step)

    def _is_candidate(
        self, numbers: IntArray, number: int, segment: int, linked_ids: Sequence[int]
    ) -> NDArray[np.bool_]:
        """Return which of (N,) earlier keyframes the one with a number may close a loop with."""
        is_other = np.array(self._segments, np.int64)[numbers] != segment
        is_old_enough = numbers < number + 1 - self._loop_config.min_gap
        return np.asarray(is_other | (is_old_enough & ~np.isin(numbers, linked_ids)))

    def candidates(self, number: int) -> NDArray[np.bool_]:
        """Return (number,), which earlier keyframes the one with a number may close a loop with."""
        earlier = np.arange(number)
        linked_ids = self._linked_ids[number]
        return self._is_candidate(earlier, number, self._segments[number], linked_ids)

    def verify(
        self, query: Keyframe, match: Keyframe, similarity: float, proposed_by: Proposal
    ) -> LoopAttempt:
        """Return what geometry makes of two keyframes that need not be alike."""
        verification, outcome, checks = verified(
            match, query, self._camera, self._verification_config
        )
        return LoopAttempt(
            query.id,
            match.id,
            similarity,
            verification,
            outcome,
            min_similarity=self.min_similarity,
            checks=checks,
            proposed_by=proposed_by,
        )

    def threshold(self) -> ThresholdFit | None:
        """Return how reliable the threshold in use is, None where nobody can tell."""
        return self._adaptive.fit(self.min_similarity) if self._adaptive else None

    def _adapt(
        self,
        keyframe: Keyframe,
        embedding: NDArray[np.float32],
        is_candidate: NDArray[np.bool_],
    ) -> None:
        """Learn from a keyframe how alike views of one place, and of different ones, are here."""
        if self._adaptive is None:
            return
        known = self._known.add(keyframe)[np.array(self._places, np.int64)]
        distances = np.where(np.isnan(known) & ~is_candidate, np.inf, known)
        unknown = np.flatnonzero(np.isnan(distances))
        is_met = distances < 1.0
        is_met[unknown[:: max(1, len(unknown) // _MOST_MET)]] = True
        ids, similarities = self._index.query(embedding, count=len(distances), among=is_met)
        self._adaptive.meet(similarities, distances[ids])
        if self._is_adapted:
            self.min_similarity = self._adaptive.min_similarity

    def _look_again(
        self, query: Keyframe, matches: Sequence[Keyframe], similarities: NDArray[np.float32]
    ) -> tuple[LoopAttempt, ...]:
        looked_at: list[tuple[int, Check | None]] = [(k, None) for k in range(len(matches))]
        # All of them are similar enough, or one is looked at that is not.
        if self._loop_config.second_look and (similarities >= self.min_similarity).any():
            looked_at = list(self._second_look.choose(query, matches))
        return tuple(
            self._attempt(query, matches[k], float(similarities[k]), second)
            for k, second in looked_at
        )

    def _attempt(
        self, query: Keyframe, match: Keyframe, similarity: float, second: Check | None
    ) -> LoopAttempt:
        needed = self.min_similarity
        first = Check.at_least(RejectionReason.LOW_SIMILARITY, similarity, needed)
        checks = (first, second) if second else (first,)
        rejection = next((each.rejection for each in checks if each.rejection), None)
        if rejection is None:
            seen = self.verify(query, match, similarity, Proposal.SIMILARITY)
            return replace(seen, checks=(*checks, *seen.checks))
        return LoopAttempt(
            query.id, match.id, similarity, None, rejection, min_similarity=needed, checks=checks
        )
