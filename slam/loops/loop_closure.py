# SPDX-License-Identifier: Apache-2.0
"""Finds the earlier keyframes that show the same place, and accounts for every candidate."""

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
from slam.loops.second_look import SecondLook
from slam.result import Calibration
from slam.types import Camera, Keyframe, LoopAttempt, Rejection, RejectionReason, RelativePose


class LoopCloser:
    """Retrieve by similarity, look again, verify by geometry; no candidate goes unrecorded."""

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
        self._looked_at: list[NDArray[np.bool_]] = []
        self._index = PlaceIndex(self._recognizer)
        self._second_look = SecondLook(camera, self._recognizer, loop_config.candidates)
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
        old_enough = len(self._keyframes) + 1 - self._loop_config.min_gap
        is_other = np.array([each.segment != keyframe.segment for each in self._keyframes], bool)
        numbers = np.arange(len(is_other))
        is_candidate = is_other | ((numbers < old_enough) & ~np.isin(numbers, linked_ids))
        wanted = max(self._loop_config.second_look, self._loop_config.candidates)
        ids, similarities = self._most_similar(embedding, is_candidate, wanted)
        # The best of those that are not similar enough answers "why was there no loop?".
        count = max(1, int(np.count_nonzero(similarities >= self.min_similarity)))
        matches = [self._keyframes[match_id] for match_id in ids[:count]]
        attempts = self._look_again(keyframe, matches, similarities[:count])
        self._keyframes.append(keyframe)
        self._looked_at.append(is_candidate)
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
        is_other = np.array([each.segment != but_segment for each in self._keyframes], bool)
        ids, similarities = self._most_similar(embedding, is_other, self._loop_config.candidates)
        return [int(k) for k in ids[similarities >= self.min_similarity]]

    def similarities(self) -> NDArray[np.float32]:
        """Return (K, K), how alike all keyframes so far are, -1 to 1."""
        return self._index.similarities()

    def calibration(self) -> Calibration | None:
        """Return where the recognizer's threshold comes from and what it met, None if unknown."""
        if self._certificate is None:
            return None
        rows = zip(self.similarities(), self._looked_at, strict=True)
        pairs = [row[: len(looked_at)][looked_at] for row, looked_at in rows]
        live = np.concatenate([np.empty(0, np.float32), *pairs])
        return Calibration(self._certificate, live)

    def _most_similar(
        self, embedding: NDArray[np.float32], is_candidate: NDArray[np.bool_], wanted: int
    ) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        limit = int(np.flatnonzero(is_candidate)[-1]) + 1 if is_candidate.any() else 0
        left_out = limit - int(np.count_nonzero(is_candidate))
        ids, similarities = self._index.query(embedding, count=wanted + left_out, limit=limit)
        chosen = np.flatnonzero(is_candidate[ids])[:wanted]
        return ids[chosen], similarities[chosen]

    def _look_again(
        self, query: Keyframe, matches: Sequence[Keyframe], similarities: NDArray[np.float32]
    ) -> tuple[LoopAttempt, ...]:
        looked_at: list[tuple[int, Rejection | None]] = [(k, None) for k in range(len(matches))]
        if self._loop_config.second_look and (similarities >= self.min_similarity).all():
            looked_at = self._second_look.choose(query, matches)
        return tuple(
            LoopAttempt(query.id, matches[k].id, float(similarities[k]), None, refusal)
            if refusal
            else self._attempt(query, matches[k], float(similarities[k]))
            for k, refusal in looked_at
        )

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
