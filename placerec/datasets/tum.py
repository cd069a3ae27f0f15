# SPDX-License-Identifier: Apache-2.0
"""Recordings in the format of the TUM RGB-D benchmark: places from camera poses (eq. 10).

Where there is a places.txt beside the lists, its lines `timestamp place` say which place each image
is meant to show, a whole number: what views were made for is not to be guessed from their poses.
"""

import logging
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placerec.datasets.place_dataset import PlaceDataset, check_images, keep_readable
from placerec.datasets.pose_distance import SAME_PLACE, FloatArray, pose_distance
from placerec.datasets.times import Clock, in_order, like_images
from placerec.datasets.tum_lists import (
    as_number,
    as_whole_number,
    nearest,
    read_images,
    read_lines,
    read_poses,
    split_fields,
)
from placerec.errors import RecognizerError
from placerec.files import is_file

_log = logging.getLogger(__name__)

_MAX_TIME_DIFFERENCE_S = 0.02
_MIN_GAP_S = 3.0
"""Frames closer in time are not compared: they are alike without any place being recognised."""
STRIDE = 3
"""Of a video every so many frames one is used; of single views, further apart than _MIN_GAP_S, as
rendered ones are, every one."""


class Recording(NamedTuple):
    """The used frames of one recording: (N,) seconds and files, (N, 3) metres, (N, 4) x y z w.

    `places` are (N,) labels, None where the recording brings none.
    """

    timestamps_s: FloatArray
    paths: tuple[Path, ...]
    positions_m: FloatArray
    quaternions: FloatArray
    places: NDArray[np.int64] | None


def read_tum(folder: Path, stride: int = STRIDE, poses: Path | None = None) -> PlaceDataset:
    """Read a folder with rgb.txt and groundtruth.txt; its depth is not looked at.

    Args:
        folder: of the recording.
        stride: every how many frames with truth one is used.
        poses: a list to take the place of groundtruth.txt, such as a run's trajectory.txt.
    """
    recording = read_recording(folder, stride, poses)
    check_images(recording.paths, _short_name(folder))
    cameras = recording.positions_m, recording.quaternions
    distance = pose_distance(*cameras, *cameras)
    everyone = np.arange(len(recording.paths))
    apart_s = np.abs(recording.timestamps_s[:, None] - recording.timestamps_s)
    dataset = PlaceDataset(
        name=_short_name(folder),
        paths=recording.paths,
        queries=everyone,
        references=everyone,
        same_place=distance < SAME_PLACE,
        comparable=apart_s > _MIN_GAP_S,
        places=_label(distance) if recording.places is None else recording.places,
        timestamps_s=recording.timestamps_s,
        positions_m=recording.positions_m,
        quaternions=recording.quaternions,
    )
    return keep_readable(dataset)


def read_tum_sessions(
    query_folder: Path, reference_folder: Path, stride: int = STRIDE
) -> PlaceDataset:
    """Read two recordings of one room: the frames of one look for their place in the other.

    The true poses of both must be in one world, as are those of the benchmark's freiburg1.
    """
    sessions = [read_recording(folder, stride) for folder in (query_folder, reference_folder)]
    timestamps_s, paths, positions_m, quaternions, _ = zip(*sessions, strict=True)
    name = f"{_short_name(query_folder)}+{_short_name(reference_folder)}"
    check_images((*paths[0], *paths[1]), name)
    everywhere_m = np.concatenate(positions_m)
    turned = np.concatenate(quaternions)
    distance = pose_distance(everywhere_m, turned, everywhere_m, turned)
    first = len(paths[0])
    same_place = distance[:first, first:] < SAME_PLACE
    dataset = PlaceDataset(
        name=name,
        paths=(*paths[0], *paths[1]),
        queries=np.arange(first),
        references=np.arange(first, len(distance)),
        same_place=same_place,
        comparable=np.ones_like(same_place),
        places=_label(distance),
        timestamps_s=np.concatenate(timestamps_s),
        positions_m=everywhere_m,
        quaternions=turned,
    )
    return keep_readable(dataset)


def read_recording(folder: Path, stride: int, poses: Path | None = None) -> Recording:
    """Return the used frames of a recording: those with a true pose, every so many of a video.

    The poses are those of groundtruth.txt, or of another list.

    Raises:
        LoopcloseError: a list cannot be used, or no frame has a true pose.
    """
    warnings: list[str] = []
    stamps_s, paths = read_images(folder / "rgb.txt", warnings)
    order, frames_s, clock = in_order(stamps_s, folder / "rgb.txt", warnings)
    truth_s, positions_m, quaternions = _read_truth(
        poses or folder / "groundtruth.txt", stamps_s, clock, warnings
    )
    for warning in warnings:
        _log.warning("%s: %s", folder, warning)
    in_truth = nearest(truth_s, frames_s)
    difference_s = np.abs(truth_s[in_truth] - frames_s)
    used = np.flatnonzero(difference_s <= _MAX_TIME_DIFFERENCE_S)
    if np.median(np.diff(frames_s, prepend=-np.inf)) <= _MIN_GAP_S:
        used = used[::stride]
    if not len(used):
        raise RecognizerError(
            f"no image has a true pose within {_MAX_TIME_DIFFERENCE_S} s; the nearest is "
            f"{difference_s.min():.6g} s away: {folder}"
        )
    return Recording(
        timestamps_s=frames_s[used],
        paths=tuple(paths[order[i]] for i in used),
        positions_m=positions_m[in_truth[used]],
        quaternions=quaternions[in_truth[used]],
        places=_read_places(folder / "places.txt", stamps_s[np.array(order)[used]]),
    )


def _short_name(folder: Path) -> str:
    return folder.resolve().name.replace("rgbd_dataset_freiburg", "fr")


def _read_places(file: Path, stamps_s: FloatArray) -> NDArray[np.int64] | None:
    """Return the place of each image by its own time stamp, None where there is no such list."""
    if not is_file(file):
        return None
    places: dict[float, int] = {}
    for number, line in read_lines(file):
        fields = split_fields(line)
        stamp_s = as_number(fields[0]) if len(fields) == 2 else None
        place = as_whole_number(fields[-1]) if len(fields) == 2 else None
        if stamp_s is None or place is None:
            raise RecognizerError(f'line {number} is not "timestamp place": {line!r}: {file}')
        places[stamp_s] = place
    missing = [stamp_s for stamp_s in stamps_s.tolist() if stamp_s not in places]
    if missing:
        raise RecognizerError(
            f"the list names no place for {len(missing)} of {len(stamps_s)} images, the first of "
            f"{missing[0]:.6f}: {file}"
        )
    return np.array([places[stamp_s] for stamp_s in stamps_s.tolist()], np.int64)


def _label(distance: FloatArray) -> NDArray[np.int64]:
    """Return labels such that any two frames of a label are of the same place.

    The first frame without a label founds a place, of all frames without one that are less than
    half the limit away: eq. 10 is a metric, so no two of them are further apart than the limit.
    """
    labels = np.full(len(distance), -1)
    for i, row in enumerate(distance):
        if labels[i] < 0:
            labels[(labels < 0) & (row < SAME_PLACE / 2.0)] = labels.max() + 1
    return labels


def _read_truth(
    file: Path, images_s: FloatArray, clock: Clock, warnings: list[str]
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (N,) seconds by the images' clock, (N, 3) metres and (N, 4) unit quaternions."""
    poses = [pose for _, pose in read_poses(file)]
    if not poses:
        raise RecognizerError(f"the list holds no true pose: {file}")
    table = np.array(poses)
    stamps_s = like_images(table[:, 0], images_s, file, warnings)
    kept, times_s, _ = in_order(stamps_s, file, warnings, clock)
    lengths = np.linalg.norm(table[kept, 4:], axis=1, keepdims=True)
    return times_s, table[kept, 1:4], table[kept, 4:] / lengths
