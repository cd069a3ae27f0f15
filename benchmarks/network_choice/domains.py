# SPDX-License-Identifier: Apache-2.0
"""What networks are chosen on: kinds of images that are neither trained on nor evaluated on."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from placerec.datasets import PlaceDataset, open_dataset
from placerec.datasets.tum import pose_distance, read_recording
from placerec.errors import RecognizerError
from placerec.evaluation.precision_recall import best_match_curve, compare, pair_curve
from placerec.training.images import Augmentation

Image = NDArray[np.uint8]

WALK_PX = (160, 120)
WALK = Augmentation(roll_deg=5.0)
WALK_NEAR, WALK_FAR = 2, 5
"""Frames of a clip up to the first apart are one place, more than the second apart are not."""
XYZ_STRIDE, XYZ_GAP_S = 2, 1.0
XYZ_NEAR, XYZ_FAR = 0.2, 0.4
"""Metres plus radians (eq. 10) below which frames are one place, and above which they are not."""


@dataclass(frozen=True)
class ImageSet:
    """A dataset and its images, which need not be as they are in its files."""

    truth: PlaceDataset
    images: Sequence[Image] | PlaceDataset


Domains = dict[str, list[ImageSet]]
SHOWN_ONLY = "views"
"""A domain that came after the rule: it is shown, and does not count."""


def open_domains(data: Path, validation: Path, views: Path | None = None) -> Domains:
    """Open all domains: ie_tower and fr1_xyz in one folder, rendered paths in another.

    In a third one there may be paths around the desk of fr1_xyz.

    Raises:
        RecognizerError: one of them is missing or broken.
    """
    clips = open_dataset(str(data / "ie_tower"), "validation")
    domains = {
        "floors": [ImageSet(clips, clips)],
        "walk": [second_pass(clips)],
        "rooms": _paths(validation, "room"),
        "desks": _paths(validation, "desk"),
        "xyz": [_by_tight_truth(data / "rgbd_dataset_freiburg1_xyz")],
    }
    if views:
        domains[SHOWN_ONLY] = _paths(views, "view")
    return domains


def _paths(folder: Path, kind: str) -> list[ImageSet]:
    paths = [open_dataset(str(path)) for path in sorted(folder.glob(f"{kind}*"))]
    if not paths:
        raise RecognizerError(
            f"there is no path in a {kind} (benchmarks.training_scenes): {folder}"
        )
    return [ImageSet(path, path) for path in paths]


def second_pass(clips: PlaceDataset) -> ImageSet:
    """Return clips walked through twice, small, the second time seen and lit a little otherwise."""
    first = [np.asarray(image) for image in clips]
    changed = [WALK(image, np.random.default_rng([0, i])) for i, image in enumerate(first)]
    small = [cv2.resize(image, WALK_PX, interpolation=cv2.INTER_AREA) for image in first + changed]
    floor = np.array([path.parent.name for path in clips.paths])
    clip = np.array([str(path).rsplit("_frame_", 1)[0] for path in clips.paths])
    number = np.array([int(path.stem.rsplit("_frame_", 1)[1]) for path in clips.paths])
    apart = np.abs(number[:, None] - number)
    is_one_clip = clip[:, None] == clip
    same_place = is_one_clip & (apart >= 1) & (apart <= WALK_NEAR)
    truth = replace(
        clips,
        paths=(*clips.paths, *clips.paths),
        queries=len(clips) + np.arange(len(clips)),
        references=np.arange(len(clips)),
        same_place=same_place,
        comparable=same_place | (is_one_clip & (apart > WALK_FAR)) | (floor[:, None] != floor),
        places=None,
    )
    return ImageSet(truth, [np.asarray(image, np.uint8) for image in small])


def _by_tight_truth(folder: Path) -> ImageSet:
    recording = read_recording(folder, XYZ_STRIDE)
    distance = pose_distance(recording.positions_m, recording.quaternions)
    apart_s = np.abs(recording.timestamps_s[:, None] - recording.timestamps_s)
    is_clear = (distance < XYZ_NEAR) | (distance > XYZ_FAR)
    everyone = np.arange(len(distance))
    truth = PlaceDataset(
        name="xyz",
        paths=recording.paths,
        queries=everyone,
        references=everyone,
        same_place=distance < XYZ_NEAR,
        comparable=(apart_s > XYZ_GAP_S) & is_clear,
    )
    return ImageSet(truth, truth)


def all_images(domains: Domains) -> Iterator[Image]:
    """Yield the images of all domains, one set after the other."""
    for sets in domains.values():
        for one in sets:
            yield from (np.asarray(image, np.uint8) for image in one.images)


def judge(domains: Domains, embeddings: NDArray[np.float32]) -> dict[str, float]:
    """Return each domain's score for (N, D) embeddings of all images, in their order.

    It is the mean of average precision and of the area under the best-match curve.
    """
    scores: dict[str, float] = {}
    start = 0
    for name, sets in domains.items():
        areas = []
        for one in sets:
            own = embeddings[start : start + len(one.truth)]
            start += len(one.truth)
            similarities = compare(own, one.truth)
            areas.append(pair_curve(similarities, one.truth).area)
            areas.append(best_match_curve(similarities, one.truth).area)
        scores[name] = float(np.mean(areas))
    return scores


def overall(scores: dict[str, float], without: str | None = None) -> float:
    """Return the geometric mean of the scores of all domains that count, or of all but one."""
    left_out = {SHOWN_ONLY, without}
    return float(np.exp(np.mean([np.log(x) for name, x in scores.items() if name not in left_out])))
