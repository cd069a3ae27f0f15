# SPDX-License-Identifier: Apache-2.0
"""What outlasts a run of its keyframes: to decide its loops again, and to go on from them."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.loops.submaps import Loop
from slam.mapping.landmark_map import LandmarkMap
from slam.types import Camera, IntArray, Keyframe, Link, LoopAttempt


@dataclass(frozen=True)
class Remembered:
    """What keyframes showed: enough to look for their loops again, and to adjust the map.

    Attributes:
        min_similarity: the recognizer's own.
        embeddings: (K, D) float32, of unit length.
        the_map: its keyframes have their features.
    """

    min_similarity: float
    embeddings: NDArray[np.float32]
    the_map: LandmarkMap


@dataclass(frozen=True)
class SavedMap:
    """A map for later runs: the keyframes that have a place, what joins them, and what they show.

    Attributes:
        camera: the camera.
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
