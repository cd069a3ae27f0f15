# SPDX-License-Identifier: Apache-2.0
"""What is shown of a run, by Rerun's own archetypes; docs/live.md lists the names."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import takewhile
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from slam.config import MapConfig
from slam.geometry import se3
from slam.output.live.archetypes import PLOTS, blueprint, jpeg, lines, pinhole, transform
from slam.output.point_cloud import fuse
from slam.result import SlamResult
from slam.system import Slam
from slam.tracking.tracked_frame import TrackedFrame, preview
from slam.types import (
    PREVIEW_SCALE,
    Camera,
    FloatArray,
    Frame,
    Keyframe,
    LoopAttempt,
    Rejection,
)

_DEPTH_STRIDE = 2  # of the preview: depth compresses badly
_UNITS_PER_M = 1000.0
_PIECE = 64  # poses: what is drawn anew with each frame
_POINTS = 200  # of a keyframe, for the map on the way
_MOST_ON_THE_WAY, _MOST_IN_THE_END = 20_000, 200_000  # points of the map
_LIVE, _ODOMETRY, _CORRECTED = (150, 150, 150), (230, 130, 30), (40, 120, 240)
_ACCEPTED, _REJECTED = (40, 170, 80), (220, 50, 50)


@dataclass
class _Seen:
    """What is kept of a keyframe."""

    preview: Frame
    segment: int
    T_odom_kf: FloatArray  # (4, 4), as of now
    points_m: FloatArray  # (P, 3), in the camera's frame
    colours: NDArray[np.uint8]  # (P, 3)


class Scene:
    """Logs a run, as it goes on, to the recordings that there are at the time."""

    def __init__(self, slam: Slam, camera: Camera, recordings: Callable[[], Iterable[Any]]) -> None:
        self._slam, self._camera, self._recordings = slam, camera, recordings
        self._keyframes: dict[int, _Seen] = {}
        self._T_first: dict[int, FloatArray] = {}  # T_world_odom by segment, when first known
        self._piece: list[FloatArray] = []  # the last positions, drawn as one line
        self._pieces = self._frames = self._attempts = 0
        self._version = 0  # of the correction that is shown
        self._first_s: float | None = None
        self._track_s = 0.0
        if slam.earlier:
            self._keyframes = {each.id: _seen(each) for each in slam.earlier.keyframes}
            self._attempts, self._version = len(slam.earlier.attempts), -1  # shown at once

    def begin(self) -> None:
        """Log what does not change."""
        for recording in self._recordings():
            recording.send_blueprint(blueprint())
        self._log("world", rr.ViewCoordinates.RDF, static=True)
        for name, scale in (("colour", PREVIEW_SCALE), ("depth", PREVIEW_SCALE / _DEPTH_STRIDE)):
            self._log(f"world/camera/{name}", pinhole(self._camera, scale), static=True)
        for name in PLOTS:
            self._log(f"plots/{name}", rr.SeriesLines(names=name.replace("_", ", ")), static=True)

    def start_session(self) -> None:
        """Let the path begin anew."""
        self._begin_piece([])

    def add(self, frame: Frame, tracked: TrackedFrame | Rejection) -> None:
        """Log a frame, what became of it, and what was found out since the one before."""
        self._first_s = frame.timestamp_s if self._first_s is None else self._first_s
        for recording in self._recordings():
            recording.set_time("frame", sequence=self._frames)
            recording.set_time("time", duration=frame.timestamp_s - self._first_s)
        self._frames += 1
        self._log_images(preview(frame))
        track_s = self._slam.clock.seconds.get("track", 0.0)
        self._log_number("tracking_ms", 1000.0 * (track_s - self._track_s))
        self._track_s = track_s
        if isinstance(tracked, Rejection):
            self._begin_piece([])
            self._tell(f"lost: {_why(tracked)}", rr.TextLogLevel.WARN)
        else:
            self._log_pose(tracked)
        self._log_attempts()
        if (version := self._slam.correction.version) != self._version:
            self._version = version
            self._log_correction()

    def finish(self, result: SlamResult) -> None:
        """Log what the run found out, in place of what it thought on the way."""
        self._log("world/live", rr.Clear(recursive=True))
        self._log("world/loop", rr.Clear(recursive=True))
        starts = result.session_starts_s
        for name, path, colour in (
            ("trajectory", result.trajectory, _CORRECTED),
            ("odometry", result.odometry, _ODOMETRY),
        ):
            cuts = np.searchsorted(path.timestamps_s, starts)
            self._log_path(name, np.split(path.T_world_cam[:, :3, 3], cuts), colour)
        T_world_kf = {
            keyframe.id: T
            for keyframe, T in zip(result.keyframes, result.T_world_kf, strict=True)
            if np.isfinite(T).all()
        }
        self._log_keyframes(T_world_kf)
        self._log_loops(result.attempts, T_world_kf)
        for attempt in result.attempts:
            if attempt.verification and attempt.weight is not None and attempt.rejection:
                self._tell(f"in the end {_verdict(attempt)}", rr.TextLogLevel.WARN)
        if result.has_images:
            cloud = fuse(result, MapConfig())
            stride = -(-len(cloud.points_m) // _MOST_IN_THE_END) or 1
            self._log_map(cloud.points_m[::stride], np.rint(cloud.colours[::stride]))
        used = sum(each.rejection is None for each in result.attempts)
        self._tell(f"{len(result.trajectory)} frames placed, {used} loops in use", "INFO")

    def _log(self, name: str, what: Any, *, static: bool = False) -> None:
        for recording in self._recordings():
            recording.log(name, what, static=static, strict=True)

    def _log_number(self, name: str, number: float) -> None:
        self._log(f"plots/{name}", rr.Scalars(number))

    def _tell(self, text: str, level: str) -> None:
        self._log("log", rr.TextLog(text, level=level))

    def _log_images(self, shown: Frame) -> None:
        self._log("world/camera/colour", jpeg(shown.rgb))
        depth = np.nan_to_num(shown.depth_m[::_DEPTH_STRIDE, ::_DEPTH_STRIDE]) * _UNITS_PER_M
        image = np.clip(depth, 0.0, 65535.0).astype(np.uint16)
        self._log("world/camera/depth", rr.DepthImage(image, meter=_UNITS_PER_M))

    def _log_pose(self, tracked: TrackedFrame) -> None:
        for k, T in tracked.moved.items():
            if k in self._keyframes:
                self._keyframes[k].T_odom_kf = T
        if tracked.new_keyframe:
            self._keyframes[tracked.new_keyframe.id] = _seen(tracked.new_keyframe)
        self._log_number("covered_percent", 100.0 * tracked.covered)
        T_world_odom = self._slam.correction.T_world_odom.get(tracked.segment)
        if T_world_odom is None:  # nothing tells where this part of the map is
            self._begin_piece([])
            return
        T_first = self._T_first.setdefault(tracked.segment, T_world_odom)
        T_world_cam, T_first_cam = (T @ tracked.T_odom_cam for T in (T_world_odom, T_first))
        shift_m = np.linalg.norm(T_world_cam[:3, 3] - T_first_cam[:3, 3])
        self._log_number("shift_mm", 1000.0 * float(shift_m))
        self._log("world/camera", transform(T_world_cam))
        self._piece.append(T_world_cam[:3, 3])
        self._log_path(f"live/{self._pieces:04d}", [np.array(self._piece)], _LIVE)
        if len(self._piece) >= _PIECE:
            self._begin_piece(self._piece[-1:])

    def _begin_piece(self, positions: list[FloatArray]) -> None:
        if self._piece:
            self._pieces += 1
        self._piece = positions

    def _log_attempts(self) -> None:
        new = list(
            takewhile(
                lambda each: each.query_id in self._keyframes,
                self._slam.attempts[self._attempts :],
            )
        )
        self._attempts += len(new)
        T_world_kf = self._placed() if new else {}
        for attempt in new:
            is_accepted = attempt.rejection is None
            level = rr.TextLogLevel.INFO if is_accepted else rr.TextLogLevel.DEBUG
            self._tell(_verdict(attempt), level)
            if attempt.verification:
                colour = _ACCEPTED if is_accepted else _REJECTED
                self._log("world/loop", lines([attempt], T_world_kf, colour))
            if is_accepted:
                self._log_matches(attempt)

    def _log_matches(self, attempt: LoopAttempt) -> None:
        verification = attempt.verification
        if verification is None or not len(verification.pixels):
            return
        match, query = (
            self._keyframes[k].preview.rgb for k in (attempt.match_id, attempt.query_id)
        )
        ends = verification.pixels.reshape(-1, 2, 2) * PREVIEW_SCALE
        ends[:, 1, 0] += match.shape[1]
        agree = verification.inlier_mask
        ends, agree = np.concatenate([ends[~agree], ends[agree]]), np.sort(agree)
        colours = np.where(agree[:, None], _ACCEPTED, _REJECTED)
        self._log("matches", jpeg(np.hstack([match, query])))
        self._log("matches/pairs", rr.LineStrips2D(ends, colors=colours.astype(np.uint8)))

    def _log_correction(self) -> None:
        T_world_kf = self._placed()
        tracked = {
            k: self._T_first[each.segment] @ each.T_odom_kf
            for k, each in self._keyframes.items()
            if each.segment in self._T_first
        }
        for name, T_kf, colour in (
            ("trajectory", T_world_kf, _CORRECTED),
            ("odometry", tracked, _ODOMETRY),
        ):
            segments: dict[int, list[FloatArray]] = {}
            for k, T in T_kf.items():
                segments.setdefault(self._keyframes[k].segment, []).append(T[:3, 3])
            self._log_path(name, list(map(np.array, segments.values())), colour)
        self._log_keyframes(T_world_kf)
        self._log_loops(self._slam.attempts[: self._attempts], T_world_kf)
        stride = -(-_POINTS * len(T_world_kf) // _MOST_ON_THE_WAY) or 1
        seen = [(self._keyframes[k], T) for k, T in T_world_kf.items()]
        if seen:
            points_m = [se3.transform(T, each.points_m[::stride]) for each, T in seen]
            self._log_map(
                np.concatenate(points_m), np.concatenate([e.colours[::stride] for e, _ in seen])
            )

    def _placed(self) -> dict[int, FloatArray]:
        """Return where keyframes are by the newest correction, (4, 4) by id, in order."""
        correction = self._slam.correction
        T_world_kf = {}
        for k, each in self._keyframes.items():
            if k in correction.T_world_kf:
                T_world_kf[k] = correction.T_world_kf[k]
            elif each.segment in correction.T_world_odom:
                T_world_kf[k] = correction.T_world_odom[each.segment] @ each.T_odom_kf
        return T_world_kf

    def _log_path(
        self, name: str, strips: Sequence[FloatArray], colour: tuple[int, int, int]
    ) -> None:
        shown = [strip.astype(np.float32) for strip in strips if len(strip)]
        self._log(f"world/{name}", rr.LineStrips3D(shown, colors=[colour]))

    def _log_keyframes(self, T_world_kf: Mapping[int, FloatArray]) -> None:
        positions = np.array([T[:3, 3] for T in T_world_kf.values()]).reshape(-1, 3)
        self._log(
            "world/keyframes",
            rr.Points3D(positions, colors=[_CORRECTED], radii=rr.Radius.ui_points(3.0)),
        )

    def _log_loops(
        self, attempts: Sequence[LoopAttempt], T_world_kf: Mapping[int, FloatArray]
    ) -> None:
        looked_at = [each for each in attempts if each.verification]
        for name, is_accepted in (("accepted", True), ("rejected", False)):
            some = [each for each in looked_at if (each.rejection is None) == is_accepted]
            colour = _ACCEPTED if is_accepted else _REJECTED
            self._log(f"world/loops/{name}", lines(some, T_world_kf, colour))

    def _log_map(self, points_m: FloatArray, colours: NDArray[Any]) -> None:
        self._log("world/map", rr.Points3D(points_m, colors=colours.astype(np.uint8)))


def _seen(keyframe: Keyframe) -> _Seen:
    features, rgb = keyframe.features, keyframe.preview.rgb
    points_m, pixels = features.points_m, features.pixels
    known = np.flatnonzero(np.isfinite(points_m).all(axis=1))
    some = known[:: -(-len(known) // _POINTS) or 1]
    height, width = rgb.shape[:2]
    u, v = (pixels[some] * PREVIEW_SCALE).astype(np.int64).T
    colours = rgb[np.clip(v, 0, height - 1), np.clip(u, 0, width - 1)]
    shown, segment = keyframe.preview, keyframe.segment
    return _Seen(shown, segment, keyframe.T_odom_cam, points_m[some].astype(np.float64), colours)


def _verdict(attempt: LoopAttempt) -> str:
    pair = f"{attempt.query_id} sees {attempt.match_id}, similarity {attempt.similarity:.3f}"
    if attempt.rejection:
        return f"{pair}: no, {_why(attempt.rejection)}"
    inliers = attempt.verification.inlier_mask.sum() if attempt.verification else 0
    return f"{pair}: yes, {inliers} matches agree"


def _why(rejection: Rejection) -> str:
    return f"{rejection.reason.value} ({rejection.measured:.3g}, needed {rejection.needed:.3g})"
