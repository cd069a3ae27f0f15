# SPDX-License-Identifier: Apache-2.0
"""A recording without labels: `run_slam` says where its camera was, poses and depth what it saw."""

import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from placerec.datasets import LabelledImages, PlaceDataset
from placerec.datasets.depth_overlap import camera_of_run, overlaps
from placerec.datasets.place_dataset import BoolMatrix
from placerec.datasets.tum import read_tum
from placerec.datasets.tum_lists import read_poses
from placerec.errors import RecognizerError
from placerec.files import is_file

TRAJECTORY_NAME, SUMMARY_NAME = "trajectory.txt", "summary.json"
HELD_BACK = 0.3
"""Share of a recording, its end, that is not learned from but judged by."""
MOST_IMAGES = 300
"""Of a recording: more of the same bring nothing new."""
LEAST_OVERLAP = 0.2
"""Two views show one place where eq. 10 says so and they have so much in sight together."""


@dataclass(frozen=True)
class OwnRecording:
    """N images of a recording, spread over it, and what is known of them.

    Attributes:
        judged: all of them; its queries are those at the end, each looked for among all.
        same: (N, N) symmetric bool, the pairs of the others that show one place.
        beyond: likewise, those that show places just beyond each other.
    """

    judged: PlaceDataset
    same: BoolMatrix
    beyond: BoolMatrix


def run_slam(recording: Path, out: Path) -> None:
    """Find a recording's poses, where that was not done before; `run_slam` shows its progress.

    Raises:
        RecognizerError: `run_slam`, which says why, found none.
    """
    if is_file(out / TRAJECTORY_NAME) and is_file(out / SUMMARY_NAME):
        return
    command = [sys.executable, "-P", "-m", "slam", str(recording), "--out", str(out)]
    done = subprocess.run(command, stdout=subprocess.DEVNULL, check=False)
    if done.returncode or not is_file(out / TRAJECTORY_NAME):
        raise RecognizerError(
            f"run_slam found no poses (exit code {done.returncode}), without which there is "
            f"nothing to learn from: {recording}"
        )


def open_own_recording(recording: Path, run: Path) -> OwnRecording:
    """Open a recording in the format of TUM RGB-D by the poses of a run.

    Raises:
        LoopcloseError: it cannot be read, or its end shows no place that was seen before.
    """
    poses = run / TRAJECTORY_NAME
    stride = -(-sum(1 for _ in read_poses(poses)) // MOST_IMAGES)
    images = read_tum(recording, max(1, stride), poses)
    learned = np.arange(len(images)) < round((1.0 - HELD_BACK) * len(images))
    judged = np.flatnonzero(~learned)
    held_back = replace(
        images,
        name=f"{images.name}, its end",
        queries=judged,
        same_place=images.same_place[judged],
        comparable=images.comparable[judged],
    )
    same = held_back.same_place[held_back.comparable]
    if not same.any() or same.all():
        which = "no place" if not same.any() else "nothing but one place"
        raise RecognizerError(
            f"the last {HELD_BACK:.0%} of {images.name} show {which} that the camera has seen "
            "before, so nobody could tell what learning from it brings; give a recording in which "
            "the camera comes back"
        )
    truth = LabelledImages([images]).pairs(np.arange(len(images)))
    pairs = learned[:, None] & learned & ~np.eye(len(images), dtype=np.bool_)
    near = truth.same & pairs
    shares = overlaps(recording, images, camera_of_run(run / SUMMARY_NAME), near)
    # Where depth is silent, poses have the only say.
    return OwnRecording(held_back, near & ~(shares < LEAST_OVERLAP), truth.beyond & pairs)
