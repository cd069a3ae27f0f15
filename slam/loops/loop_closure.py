# SPDX-License-Identifier: Apache-2.0
"""Finds the earlier keyframes that show the same place, and accounts for every candidate."""

from array import array
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from placerec.certificate import certificate_of
from placerec.checked_recognizer import CheckedRecognizer
from placerec.index import PlaceIndex
from placerec.recognizer import PlaceRecognizer
from slam.config import LoopConfig, VerificationConfig
from slam.geometry.motion_noise import loop_noise, translation_sigma_m, typical_depth_m
from slam.geometry.relative_pose import estimate_relative_pose
from slam.result import Calibration, compared
from slam.types import Camera, Keyframe, LoopAttempt, Rejection, RejectionReason, RelativePose


class LoopCloser:
    """Retrieve by similarity, verify by geometry; no candidate goes unrecorded."""

    def __init__(
        self,
        camera: Camera,
        recognizer: PlaceRecognizer,
        loop_config: LoopConfig,
        verification_config: VerificationConfig,
    ) -> None:
        self._camera = camera
        self._recognizer = CheckedRecognizer(recognizer, limit_s=loop_config.recognizer_limit_s)
        self._certificate = certificate_of(recognizer)
        self._loop_config = loop_config
        self._verification_config = verification_config
        self._keyframes: list[Keyframe] = []
        self._segments = array("q")  # of each keyframe
        self._linked_ids: list[Sequence[int]] = []  # to each keyframe
        self._index = PlaceIndex(self._recognizer.comparer)
        chosen = loop_config.min_similarity
        self.min_similarity = self._recognizer.min_similarity if chosen is None else chosen

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
        is_candidate = self._is_candidate(len(self._keyframes), keyframe.segment, linked_ids)
        ids, similarities = self._most_similar(embedding, is_candidate)
        # The best of those that are not similar enough answers "why was there no loop?".
        count = max(1, int(np.count_nonzero(similarities >= self.min_similarity)))
        attempts = tuple(
            self._attempt(keyframe, self._keyframes[match_id], float(similarity))
            for match_id, similarity in zip(ids[:count], similarities[:count], strict=True)
        )
        self._keyframes.append(keyframe)
        self._segments.append(keyframe.segment)
        self._linked_ids.append(tuple(linked_ids))
        self._index.add(embedding)
        return attempts

    def most_similar(
        self, embedding: NDArray[np.float32], but_segment: int | None = None
    ) -> list[int]:
        """Return the keyframes, however new, that are similar enough to be verified, best first.

        Those of but_segment are left out.

        Raises:
            RecognizerError: the recognizer compares its embeddings itself, and failed.
        """
        segments = np.array(self._segments, np.int64)
        is_other = np.ones(len(segments), bool) if but_segment is None else segments != but_segment
        ids, similarities = self._most_similar(embedding, is_other)
        return [int(k) for k in ids[similarities >= self.min_similarity]]

    def similarities(self) -> NDArray[np.float32]:
        """Return (N, N), how alike the `compared` keyframes are, -1 to 1."""
        return self._index.similarities(compared(len(self._keyframes)).step)

    def calibration(self, similarities: NDArray[np.float32]) -> Calibration | None:
        """Return where the recognizer's threshold comes from and what it met, None if unknown.

        What it met are the `similarities` of now.
        """
        if self._certificate is None:
            return None
        pairs, shown = [np.empty(0, np.float32)], compared(len(self._keyframes))
        for k, row in zip(shown, similarities, strict=True):
            looked_at = self._is_candidate(k, self._segments[k], self._linked_ids[k])[:: shown.step]
            pairs.append(row[: len(looked_at)][looked_at])
        return Calibration(self._certificate, np.concatenate(pairs), shown.step)

    def _is_candidate(
        self, number: int, segment: int, linked_ids: Sequence[int]
    ) -> NDArray[np.bool_]:
        """Return (number,), which keyframes the one with a number may close a loop with."""
        is_other = np.array(self._segments, np.int64)[:number] != segment
        numbers = np.arange(number)
        is_old_enough = numbers < number + 1 - self._loop_config.min_gap
        return np.asarray(is_other | (is_old_enough & ~np.isin(numbers, linked_ids)))

    def _most_similar(
        self, embedding: NDArray[np.float32], is_candidate: NDArray[np.bool_]
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        return self._index.query(embedding, self._loop_config.candidates, is_candidate)

    def _attempt(self, query: Keyframe, match: Keyframe, similarity: float) -> LoopAttempt:
        if similarity < self.min_similarity:
            rejection = Rejection(RejectionReason.LOW_SIMILARITY, similarity, self.min_similarity)
            return LoopAttempt(query.id, match.id, similarity, None, rejection)
        config = self._verification_config
        verification = estimate_relative_pose(match.features, query.features, self._camera, config)
        outcome = verification.outcome
        if isinstance(outcome, RelativePose):
            depth_m = typical_depth_m(match.features, query.features)
            turning = (match.turning_rad_s, query.turning_rad_s)
            outcome = loop_noise(outcome, self._camera, depth_m, *turning)
            share, most = translation_sigma_m(outcome) / depth_m, config.max_uncertainty
            if share > most:
                outcome = Rejection(RejectionReason.UNCERTAIN_MOTION, share, most)
        return LoopAttempt(query.id, match.id, similarity, verification, outcome)
