# SPDX-License-Identifier: Apache-2.0
"""A map to be kept, and to go on from."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from slam.loops.submaps import Loop
from slam.mapping.landmark_map import LandmarkMap
from slam.mapping.stored_map import part_of_map
from slam.types import Camera, FloatArray, IntArray, Keyframe, Link, LoopAttempt


@dataclass(frozen=True)
class SavedMap:
    """A map for later runs: the keyframes that have a place, what joins them, and what they show.

    Attributes:
        camera: of the recording that it began with; keyframes name theirs.
        fingerprint: of the recognizer that made the embeddings.
        keyframes: K, numbered from 0; T_odom_cam is in the map's frame, and all are one segment.
        sessions: (K,) the number of the recording that each is from.
        frames: (K,) how many frames were placed against each.
        embeddings: (K, *S) float32.
        is_new: (K,) bool, whether it showed something new of its place.
        links: the motions between keyframes that are no loops; they lead to every one.
        loops: those in use.
        attempts: the same loops, with how alike the views are, their weights and their numbers of
            matches, but not the matches.
        the_map: landmarks, and the same keyframes with what they see.
        ledger: every loop decision, as lines of the ledger; of the runs until now.
    """

    camera: Camera
    fingerprint: str
    keyframes: tuple[Keyframe, ...]
    sessions: IntArray
    frames: IntArray
    embeddings: NDArray[np.float32]
    is_new: NDArray[np.bool_]
    links: tuple[Link, ...]
    loops: tuple[Loop, ...]
    attempts: tuple[LoopAttempt, ...]
    the_map: LandmarkMap
    ledger: tuple[str, ...] = ()

    def placed(self, T_world_kf: FloatArray) -> "SavedMap":
        """Return the map of the keyframes that (K, 4, 4) poses give a place, NaN where they do not.

        It is moved there, and they are numbered anew and one segment.
        """
        placed = np.flatnonzero(np.isfinite(T_world_kf[:, 0, 0]))
        number = dict(zip(placed.tolist(), range(len(placed)), strict=True))
        used = [
            (
                replace(loop, ref_id=number[loop.ref_id], query_id=number[loop.query_id]),
                replace(each, match_id=number[each.match_id], query_id=number[each.query_id]),
            )
            for loop, each in zip(self.loops, self.attempts, strict=True)
            if loop.ref_id in number and loop.query_id in number
        ]
        part = part_of_map(self.the_map, placed.tolist())
        part.move_keyframes(range(len(placed)), T_world_kf[placed])
        return replace(
            self,
            keyframes=tuple(
                replace(
                    self.keyframes[k],
                    id=n,
                    T_odom_cam=T_world_kf[k],
                    segment=0,
                    camera=self.keyframes[k].camera or self.camera,
                )
                for k, n in number.items()
            ),
            sessions=self.sessions[placed],
            frames=self.frames[placed],
            embeddings=self.embeddings[placed],
            is_new=self.is_new[placed],
            links=tuple(
                Link(number[each.ref_id], number[each.query_id], each.motion)
                for each in self.links
                if each.ref_id in number and each.query_id in number
            ),
            loops=tuple(loop for loop, _ in used),
            attempts=tuple(each for _, each in used),
            the_map=part,
        )
