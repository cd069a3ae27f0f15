# SPDX-License-Identifier: Apache-2.0
"""What a run measured, measurements.npz: enough to decide about its loops again, without images.

`docs/ledger.md` has the arrays.
"""

import io
import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placerec.errors import cause_of
from placerec.files import arrays_of, read_bytes, write_atomically
from slam.config import Config
from slam.loops.remembered import Remembered
from slam.mapping.landmark_map import LandmarkMap
from slam.mapping.stored_map import Arrays, arrays_of_map, map_of_arrays
from slam.output.journal import Header, Journal, blank_preview, header_of, told_of
from slam.output.journal_lines import attempt_line, attempt_of
from slam.tracking.tracked_frame import TrackedFrame
from slam.types import (
    Features,
    FloatArray,
    Frame,
    Keyframe,
    Link,
    RelativePose,
    SlamError,
    Trajectory,
)

MEASUREMENTS = "measurements.npz"
VERSION = 1
"""Of what the file holds: larger whenever a reader of the one before would be misled."""

_MOST_BYTES = 1 << 31
_UPPER = np.triu_indices(6)
_LAST_ROW = np.array([0.0, 0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Measurements:
    """What a run measured.

    Attributes:
        journal: its frames; where loops can be decided again the keyframes have their features, and
            else there is what became of the loop candidates.
        remembered: what deciding again takes, None where it is not kept.
        truth: the true camera poses as they were read, None without.
    """

    journal: Journal
    remembered: Remembered | None
    truth: Trajectory | None


def write_measurements(path: Path, measured: Measurements) -> None:
    """Write the arrays; the same measurements always give the same bytes.

    Raises:
        LoopcloseError: the file cannot be written.
    """
    journal, remembered = measured.journal, measured.remembered
    about: dict[str, Any] = {"version": VERSION, **told_of(journal.header)}
    about["is_whole"] = journal.is_whole
    arrays = {**_of_frames(journal), **_of_keyframes(journal)}
    if measured.truth is not None:
        arrays["truth_timestamp_s"] = measured.truth.timestamps_s
        arrays["truth_T_world_cam"] = measured.truth.T_world_cam[:, :3]
    if remembered:
        about["recognizer_min_similarity"] = remembered.min_similarity
        arrays |= {"embedding": remembered.embeddings, **arrays_of_map(remembered.the_map)}
    else:
        attempts = [each for some in journal.attempts.values() for each in some]
        lines = "".join(f"{json.dumps(attempt_line(each))}\n" for each in attempts)
        arrays["loops_jsonl"] = np.frombuffer(lines.encode(), np.uint8)
    arrays["about_json"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
    content = io.BytesIO()
    write = np.savez if remembered else np.savez_compressed  # features hardly get any smaller
    write(content, allow_pickle=False, **arrays)
    write_atomically(path, content.getvalue())


def read_measurements(path: Path, config: Config) -> Measurements:
    """Read back what a run measured, for deciding with these settings.

    Raises:
        SlamError: there is none, it is damaged, or of another version.
    """
    content = read_bytes(path, _MOST_BYTES, what="what the run measured", kind=SlamError)
    try:
        arrays = arrays_of(content)
        about = json.loads(arrays["about_json"].tobytes())
        version = about.pop("version")
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise SlamError(f"this does not hold what a run measured, or is cut off: {path}") from error
    if version != VERSION:
        told = "update loopclose" if str(version) > str(VERSION) else "run again"
        raise SlamError(
            f"these measurements are of version {version}, and this reads {VERSION}: {told}: {path}"
        )
    try:
        return _measurements(arrays, about, config)
    except Exception as error:  # whatever arrays that do not fit each other lead to
        raise SlamError(f"what the run measured is damaged ({cause_of(error)}): {path}") from error


def _measurements(arrays: Arrays, about: dict[str, Any], config: Config) -> Measurements:
    own = about.pop("recognizer_min_similarity", None)
    is_whole = bool(about.pop("is_whole"))
    header = header_of(about)
    T_odom_kf = _whole(arrays["keyframe_T_odom_end"])
    features: list[Features | None] = [None] * len(T_odom_kf)
    remembered = None
    if own is not None:
        empty = LandmarkMap(
            header.camera, config.features.levels, config.verification.max_descriptor_distance
        )
        the_map = map_of_arrays(arrays, T_odom_kf, empty)
        features = [each.features for each in the_map.keyframes]
        remembered = Remembered(float(own), arrays["embedding"], the_map)
        if len(remembered.embeddings) != len(features):
            raise ValueError("embeddings")
    journal = _journal(arrays, header, features)
    for k, T in enumerate(T_odom_kf):
        journal.T_odom_kf[k] = T
    if remembered is None:
        for line in arrays["loops_jsonl"].tobytes().splitlines():
            attempt = attempt_of(json.loads(line))
            journal.attempts.setdefault(attempt.query_id, []).append(attempt)
    truth = None
    if "truth_timestamp_s" in arrays:
        truth = Trajectory(arrays["truth_timestamp_s"], _whole(arrays["truth_T_world_cam"]))
    return Measurements(replace(journal, is_whole=is_whole), remembered, truth)


def _of_frames(journal: Journal) -> dict[str, NDArray[Any]]:
    placed = [tracked for _, tracked in journal.frames if tracked]
    return {
        "frame_timestamp_s": np.array([timestamp_s for timestamp_s, _ in journal.frames]),
        "frame_is_placed": np.array([each is not None for _, each in journal.frames], bool),
        "session_start": np.array(sorted(journal.session_starts), np.int64),
        "placed_is_keyframe": np.array([bool(each.new_keyframe) for each in placed], bool),
        "placed_keyframe": np.array([each.keyframe_id for each in placed], np.int64),
        "placed_segment": np.array([each.segment for each in placed], np.int64),
        "placed_T_kf_cam": _rows([each.T_kf_cam for each in placed]),
        "placed_T_odom_cam": _rows([each.T_odom_cam for each in placed]),
        "placed_covered": np.array([each.covered for each in placed]),
    }


def _of_keyframes(journal: Journal) -> dict[str, NDArray[Any]]:
    frames = [tracked for _, tracked in journal.frames if tracked and tracked.new_keyframe]
    keyframes = [each.new_keyframe for each in frames if each.new_keyframe]
    links = [link for each in frames for link in each.links]
    moved = [item for each in frames for item in each.moved.items()]
    last = [journal.T_odom_kf.get(each.id, each.T_odom_cam) for each in keyframes]
    return {
        "keyframe_timestamp_s": np.array([each.timestamp_s for each in keyframes]),
        "keyframe_T_odom_cam": _rows([each.T_odom_cam for each in keyframes]),
        "keyframe_T_odom_end": _rows(last),
        "keyframe_turning_rad_s": np.array([each.turning_rad_s for each in keyframes]),
        "link_count": np.array([len(each.links) for each in frames], np.int64),
        "link_keyframes": np.array([(k.ref_id, k.query_id) for k in links], np.int64).reshape(
            -1, 2
        ),
        "link_T_ref_query": _rows([each.motion.T_ref_query for each in links]),
        "link_information": np.array([each.motion.information[_UPPER] for each in links]).reshape(
            -1, 21
        ),
        "moved_count": np.array([len(each.moved) for each in frames], np.int64),
        "moved_keyframe": np.array([k for k, _ in moved], np.int64),
        "moved_T_odom_cam": _rows([T for _, T in moved]),
    }


def _journal(arrays: Arrays, header: Header, features: list[Features | None]) -> Journal:
    image = blank_preview(header.camera)
    keyframes = iter(_keyframe_frames(arrays, features, image))
    names = ("is_keyframe", "keyframe", "segment", "T_kf_cam", "T_odom_cam", "covered")
    columns = [arrays[f"placed_{name}"] for name in names]
    placed: list[TrackedFrame] = []
    T_kf_cam, T_odom_cam = _whole(columns[3]), _whole(columns[4])
    for n, (is_keyframe, keyframe, segment) in enumerate(zip(*columns[:3], strict=True)):
        tracked = TrackedFrame(
            int(keyframe), T_kf_cam[n], T_odom_cam[n], int(segment), covered=float(columns[5][n])
        )
        if is_keyframe:
            new, links, moved = next(keyframes)
            new = replace(new, id=tracked.keyframe_id, segment=tracked.segment)
            tracked = replace(tracked, new_keyframe=new, links=links, moved=moved)
        placed.append(tracked)
    left = iter(placed)
    stamps_s, is_placed = arrays["frame_timestamp_s"], arrays["frame_is_placed"]
    frames = [
        (float(t), next(left) if there else None)
        for t, there in zip(stamps_s, is_placed, strict=True)
    ]
    return Journal(header, frames, {int(each) for each in arrays["session_start"]})


def _keyframe_frames(
    arrays: Arrays, features: list[Features | None], image: Frame
) -> list[tuple[Keyframe, tuple[Link, ...], dict[int, FloatArray]]]:
    """Return keyframes, whose ids and segments are told elsewhere, with their links and moves."""
    information = np.zeros((len(arrays["link_information"]), 6, 6))
    information[:, *_UPPER] = information[:, *_UPPER[::-1]] = arrays["link_information"]
    links = [
        Link(int(ref), int(query), RelativePose(T, each))
        for (ref, query), T, each in zip(
            arrays["link_keyframes"], _whole(arrays["link_T_ref_query"]), information, strict=True
        )
    ]
    moved = list(
        zip(arrays["moved_keyframe"].tolist(), _whole(arrays["moved_T_odom_cam"]), strict=True)
    )
    T_odom_cam = _whole(arrays["keyframe_T_odom_cam"])
    found, link, move = [], 0, 0
    for k, (timestamp_s, turning_rad_s, link_count, moved_count) in enumerate(
        zip(
            arrays["keyframe_timestamp_s"].tolist(),
            arrays["keyframe_turning_rad_s"].tolist(),
            arrays["link_count"].tolist(),
            arrays["moved_count"].tolist(),
            strict=True,
        )
    ):
        keyframe = Keyframe(
            k, timestamp_s, T_odom_cam[k], features[k] or Features.none(), image, turning_rad_s
        )
        found.append(
            (
                keyframe,
                tuple(links[link : link + link_count]),
                dict(moved[move : move + moved_count]),
            )
        )
        link, move = link + link_count, move + moved_count
    return found


def _rows(T: list[FloatArray]) -> FloatArray:
    """Return (N, 3, 4), the upper three rows of (4, 4) transforms."""
    return np.array([each[:3] for each in T]).reshape(-1, 3, 4)


def _whole(rows: NDArray[Any]) -> FloatArray:
    """Return (N, 4, 4) transforms by their upper three rows."""
    T = np.zeros((len(rows), 4, 4))
    T[:, :3], T[:, 3] = rows, _LAST_ROW
    return T
