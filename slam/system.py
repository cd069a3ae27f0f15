# SPDX-License-Identifier: Apache-2.0
"""The pipeline in one screen: track, describe, retrieve, verify, constrain, correct."""

import numpy as np

from placerec.errors import RecognizerError
from placerec.recognizer import PlaceRecognizer
from slam.config import Config
from slam.geometry import se3
from slam.geometry.features import FeatureExtractor
from slam.loops.atlas import tied
from slam.loops.back_end import BackEnd, ClosedLoops
from slam.mapping.map_adjustment import closed_map, too_large, where_tracking_put
from slam.result import SlamResult
from slam.stage_clock import StageClock
from slam.tracking.frame_log import Rides, check_frame, checked_pose
from slam.tracking.odometry import RgbdOdometry, TrackedFrame
from slam.tracking.smoothing import smoothed
from slam.types import (
    Camera,
    FloatArray,
    Frame,
    Keyframe,
    Link,
    LoopAttempt,
    Rejection,
    RelativePose,
    SlamError,
    Trajectory,
    preview,
)


class Slam:
    """RGB-D SLAM with loop closure.

    Two doors into one object: `process(frame)` tracks the camera itself; `add_keyframe(frame,
    T_odom_cam)` takes poses from any other odometry. A run goes through one of them; either way
    `finish()` returns the result.
    """

    def __init__(
        self, camera: Camera, recognizer: PlaceRecognizer, config: Config | None = None
    ) -> None:
        self._camera = camera
        self._config = config or Config()
        self._odometry = RgbdOdometry(camera, self._config)
        self._extractor = FeatureExtractor(camera, self._config.features)
        self.clock = StageClock()
        self._back_end = BackEnd(camera, recognizer, self._config, self.clock)
        self._last: Keyframe | None = None  # of this session
        self._added = 0
        self._rides = Rides()
        self._last_s = -np.inf
        self._is_new_session = False
        self._session_starts_s: list[float] = []
        self._door = ""

    @property
    def has_keyframes(self) -> bool:
        """Whether there is anything to finish."""
        return not self._back_end.is_empty

    def process(self, frame: Frame) -> TrackedFrame | Rejection:
        """Take the next frame of the camera and return where it was placed, or why it was not.

        Raises:
            SlamError: the frame is not of the camera's size, or the time does not increase.
            RecognizerError: the recognizer failed on a keyframe, up to eight before this one; what
                was done until then can be finished.
        """
        check_frame(frame, self._camera, self._last_s)
        self._enter("process", frame)
        with self.clock.stage("track"):
            tracked = self._odometry.track(frame)
        if isinstance(tracked, Rejection):
            self._rides.lose(frame.timestamp_s)
            return tracked
        if tracked.new_keyframe is None:
            self._rides.add(frame.timestamp_s, tracked.keyframe_id, tracked.T_kf_cam)
        else:
            self._insert(tracked.new_keyframe, tracked.links, frame)
        return tracked

    def start_session(self) -> None:
        """Take the next frame for the first of another recording, which may begin anywhere.

        Loops tell how the sessions lie to each other. The camera stays the same, and time goes on.
        """
        self._is_new_session = self._door != ""
        self._last = None
        self._odometry.start_session()

    def add_keyframe(self, frame: Frame, T_odom_cam: FloatArray) -> tuple[LoopAttempt, ...]:
        """Take a keyframe whose (4, 4) pose comes from elsewhere and return its loop candidates.

        Raises:
            SlamError: the frame is not of the camera's size, the time does not increase, or the
                pose is not a rigid transform.
            RecognizerError: the recognizer failed; what was done until then can be finished.
        """
        T_odom_cam = checked_pose(frame.timestamp_s, T_odom_cam)
        check_frame(frame, self._camera, self._last_s)
        self._enter("add_keyframe", frame)
        last = self._last
        keyframe = Keyframe(
            id=self._added,
            timestamp_s=frame.timestamp_s,
            T_odom_cam=T_odom_cam,
            features=self._extractor.extract(frame),
            preview=preview(frame),
            turning_rad_s=_turning_rad_s(last, frame.timestamp_s, T_odom_cam) if last else 0.0,
            segment=len(self._session_starts_s),
        )
        links: tuple[Link, ...] = ()
        if last:
            T_last_cam = se3.inverse(last.T_odom_cam) @ T_odom_cam
            motion = RelativePose(T_last_cam, self._outside_information())
            links = (Link(last.id, keyframe.id, motion),)
        self._insert(keyframe, links, frame)
        self._added += 1
        return self._back_end.settle()

    def _insert(self, keyframe: Keyframe, links: tuple[Link, ...], frame: Frame) -> None:
        self._back_end.insert(keyframe, links, frame.rgb)
        self._last = keyframe
        self._rides.add(frame.timestamp_s, keyframe.id, np.eye(4))

    def T_world_odom(self) -> FloatArray:
        """Return the (4, 4) correction as of now: from the odometry's frame to the world.

        It solves the graph, which takes the longer the longer the run is, and no frame is tracked.

        Raises:
            SlamError: there is no keyframe yet, or nothing tells where the camera is since it was
                lost or a session began.
            RecognizerError: the recognizer failed on one of the last keyframes; what was done until
                then can be finished.
        """
        return self._back_end.T_world_odom(self._rides.per_keyframe())

    def settle(self) -> None:
        """Wait until all keyframes are taken in.

        Raises:
            RecognizerError: the recognizer failed on one; what was done until then can be finished.
        """
        self._back_end.settle()

    def finish(self) -> SlamResult:
        """Solve the graph with all loops, adjust the map to it, and return what the run found out.

        Raises:
            SlamError: no frame could be tracked.
            RecognizerError: the recognizer failed on the first keyframe.
        """
        failures = self._last_failure()
        keyframes = tuple(self._back_end.keyframes)
        if not keyframes:
            raise SlamError(
                "no frame could be tracked: none shows enough texture with depth; check the depth"
                " scale and the images, or lower --odometry.min-inliers"
            )
        loops = self._back_end.solve(self._rides.per_keyframe())
        T_world_kf = loops.T_world_kf
        unadjusted = too_large(len(keyframes)) if self._door == "process" else ()
        if self._door == "process":
            self._odometry.settle()
            keyframes = where_tracking_put(self._odometry.map, keyframes)
            if not unadjusted:
                with self.clock.stage("adjust"):
                    T_world_kf = self._adjusted(loops)
        keyframes = tied(keyframes, loops.links)
        has_place = np.isfinite(T_world_kf)
        T_odom_kf = np.array([each.T_odom_cam for each in keyframes])
        calibration = self._back_end.calibration()
        return SlamResult(
            camera=self._camera,
            keyframes=keyframes,
            T_world_kf=T_world_kf,
            odometry=self._trajectory(np.where(has_place, T_odom_kf, np.nan)),
            trajectory=self._trajectory(T_world_kf),
            links=loops.links,
            attempts=loops.attempts,
            similarities=self._back_end.similarities(),
            min_similarity=self._back_end.min_similarity,
            untracked_s=self._rides.untracked_s(T_world_kf),
            stage_seconds=dict(self.clock.seconds),
            warnings=(
                *failures,
                *self._rides.warnings(T_world_kf),
                *unadjusted,
                *loops.warnings,
                *(calibration.warnings if calibration else ()),
            ),
            calibration=calibration,
            unjoined_s=self._rides.unjoined_s(T_world_kf),
            session_starts_s=np.array(self._session_starts_s),
            elapsed_s=self.clock.elapsed_s,
        )

    def _last_failure(self) -> tuple[str, ...]:
        try:
            self._back_end.settle()
        except RecognizerError as error:
            if not self._back_end.keyframes:
                raise
            left_out = f"all from keyframe {len(self._back_end.keyframes)} on"
            return (f"{left_out} is left out: {error}",)
        return ()

    def _adjusted(self, loops: ClosedLoops) -> FloatArray:
        T_world_kf = loops.T_world_kf.copy()
        placed = np.flatnonzero(np.isfinite(T_world_kf[:, 0, 0])).tolist()
        pairs = loops.trusted_pairs()
        final = closed_map(self._odometry.map, placed, T_world_kf[placed], pairs)
        T_world_kf[placed] = [final.keyframes[k].T_map_cam for k in placed]
        return T_world_kf

    def _trajectory(self, T_any_kf: FloatArray) -> Trajectory:
        trajectory = self._rides.trajectory(T_any_kf)
        if self._door != "process":  # an odometry from elsewhere knows best how its camera moves
            return trajectory
        return smoothed(trajectory, self._config.motion, self._session_starts_s)

    def _outside_information(self) -> FloatArray:
        rotation_rad = np.radians(self._config.graph.outside_rotation_sigma_deg)
        translation_m = self._config.graph.outside_translation_sigma_m
        return np.diag([rotation_rad**-2.0] * 3 + [translation_m**-2.0] * 3)

    def _enter(self, door: str, frame: Frame) -> None:
        if self._door not in ("", door):
            raise SlamError(f"this run goes through {self._door}; start another Slam for {door}")
        self._door, self._last_s = door, frame.timestamp_s
        if self._is_new_session:
            self._session_starts_s.append(frame.timestamp_s)
            self._is_new_session = False


def _turning_rad_s(last: Keyframe, timestamp_s: float, T_odom_cam: FloatArray) -> float:
    turned_rad = se3.rotation_angle(se3.inverse(last.T_odom_cam) @ T_odom_cam)
    return float(turned_rad) / (timestamp_s - last.timestamp_s)
