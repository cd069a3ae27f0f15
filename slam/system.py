# SPDX-License-Identifier: Apache-2.0
"""The pipeline in one screen: track, describe, retrieve, verify, constrain, correct."""

from dataclasses import dataclass, replace

import numpy as np

from placerec.recognizer import PlaceRecognizer, RecognizerError
from slam import se3
from slam.back_end import BackEnd, ClosedLoops
from slam.config import Config
from slam.features import FeatureExtractor
from slam.final_map import closed_map, too_large
from slam.odometry import RgbdOdometry, TrackedFrame
from slam.preview import preview
from slam.stage_clock import StageClock
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
    SlamResult,
    Trajectory,
)


@dataclass(frozen=True)
class _Ride:
    """A frame rides on its keyframe: it is corrected when the keyframe is."""

    timestamp_s: float
    keyframe_id: int
    T_kf_cam: FloatArray


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
        self._last: Keyframe | None = None
        self._rides: list[_Ride] = []
        self._untracked_s: list[float] = []
        self._last_s = -np.inf
        self._door = ""

    @property
    def has_keyframes(self) -> bool:
        """Whether there is anything to finish."""
        return not self._back_end.is_empty

    def process(self, frame: Frame) -> TrackedFrame | Rejection:
        """Take the next frame of the camera and return where it was placed, or why it was not.

        Raises:
            SlamError: the frame is not of the camera's size, or the time does not increase.
            RecognizerError: the recognizer failed on the keyframe before; what was done until then
                can be finished.
        """
        self._check_frame(frame)
        self._enter("process", frame)
        with self.clock.stage("track"):
            tracked = self._odometry.track(frame)
        if isinstance(tracked, Rejection):
            self._untracked_s.append(frame.timestamp_s)
            return tracked
        if tracked.new_keyframe is None:
            self._rides.append(_Ride(frame.timestamp_s, tracked.keyframe_id, tracked.T_kf_cam))
        else:
            self._insert(tracked.new_keyframe, tracked.links, frame)
        return tracked

    def add_keyframe(self, frame: Frame, T_odom_cam: FloatArray) -> tuple[LoopAttempt, ...]:
        """Take a keyframe whose (4, 4) pose comes from elsewhere and return its loop candidates.

        Raises:
            SlamError: the frame is not of the camera's size, the time does not increase, or the
                pose is not a rigid transform.
            RecognizerError: the recognizer failed; what was done until then can be finished.
        """
        T_odom_cam = _checked_pose(frame.timestamp_s, T_odom_cam)
        self._check_frame(frame)
        self._enter("add_keyframe", frame)
        last = self._last
        keyframe = Keyframe(
            id=last.id + 1 if last else 0,
            timestamp_s=frame.timestamp_s,
            T_odom_cam=T_odom_cam,
            features=self._extractor.extract(frame),
            preview=preview(frame),
            turning_rad_s=_turning_rad_s(last, frame.timestamp_s, T_odom_cam) if last else 0.0,
        )
        links: tuple[Link, ...] = ()
        if last:
            T_last_cam = se3.inverse(last.T_odom_cam) @ T_odom_cam
            motion = RelativePose(T_last_cam, self._outside_information())
            links = (Link(last.id, keyframe.id, motion),)
        self._insert(keyframe, links, frame)
        return self._back_end.settle()

    def _insert(self, keyframe: Keyframe, links: tuple[Link, ...], frame: Frame) -> None:
        self._back_end.insert(keyframe, links, frame.rgb)
        self._last = keyframe
        self._rides.append(_Ride(frame.timestamp_s, keyframe.id, np.eye(4)))

    def T_world_odom(self) -> FloatArray:
        """Return the (4, 4) correction as of now: from the odometry's frame to the world.

        It solves the graph, which takes the longer the longer the run is, and no frame is tracked.

        Raises:
            SlamError: there is no keyframe yet.
            RecognizerError: the recognizer failed on one of the last keyframes; what was done until
                then can be finished.
        """
        return self._back_end.T_world_odom()

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
        loops = self._back_end.solve()
        T_world_kf = loops.T_world_kf
        unadjusted = too_large(len(keyframes)) if self._door == "process" else ()
        if self._door == "process":
            keyframes = self._where_tracking_put(keyframes)
            if not unadjusted:
                with self.clock.stage("adjust"):
                    T_world_kf = self._adjusted(loops)
        calibration = self._back_end.calibration()
        return SlamResult(
            camera=self._camera,
            keyframes=keyframes,
            T_world_kf=T_world_kf,
            odometry=self._trajectory(np.array([each.T_odom_cam for each in keyframes])),
            trajectory=self._trajectory(T_world_kf),
            links=tuple(self._back_end.links),
            attempts=loops.attempts,
            similarities=self._back_end.similarities(),
            min_similarity=self._back_end.min_similarity,
            untracked_s=np.array(self._untracked_s),
            stage_seconds=dict(self.clock.seconds),
            warnings=(
                *failures,
                *self._tracking_warnings(),
                *unadjusted,
                *loops.warnings,
                *(calibration.warnings if calibration else ()),
            ),
            calibration=calibration,
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

    def _where_tracking_put(self, keyframes: tuple[Keyframe, ...]) -> tuple[Keyframe, ...]:
        """Return the keyframes at their final places in the tracker's map, without any loop."""
        mapped = self._odometry.map.keyframes[: len(keyframes)]
        return tuple(
            replace(keyframe, T_odom_cam=each.T_map_cam)
            for keyframe, each in zip(keyframes, mapped, strict=True)
        )

    def _adjusted(self, loops: ClosedLoops) -> FloatArray:
        T_world_kf = loops.T_world_kf
        final = closed_map(self._odometry.map, T_world_kf, loops.trusted_pairs())
        return np.array([each.T_map_cam for each in final.keyframes[: len(T_world_kf)]])

    def _trajectory(self, T_any_kf: FloatArray) -> Trajectory:
        rides = [ride for ride in self._rides if ride.keyframe_id < len(T_any_kf)]
        return Trajectory(
            timestamps_s=np.array([ride.timestamp_s for ride in rides]),
            T_world_cam=np.array([T_any_kf[ride.keyframe_id] @ ride.T_kf_cam for ride in rides]),
        )

    def _tracking_warnings(self) -> tuple[str, ...]:
        if not self._untracked_s:
            return ()
        total = len(self._untracked_s) + len(self._rides)
        return (
            f"{len(self._untracked_s)} of {total} frames could not be tracked and are in no"
            f" trajectory; the first at {self._untracked_s[0]:.3f} s",
        )

    def _outside_information(self) -> FloatArray:
        rotation_rad = np.radians(self._config.graph.outside_rotation_sigma_deg)
        translation_m = self._config.graph.outside_translation_sigma_m
        return np.diag([rotation_rad**-2.0] * 3 + [translation_m**-2.0] * 3)

    def _enter(self, door: str, frame: Frame) -> None:
        if self._door not in ("", door):
            raise SlamError(f"this run goes through {self._door}; start another Slam for {door}")
        self._door, self._last_s = door, frame.timestamp_s

    def _check_frame(self, frame: Frame) -> None:
        if not frame.timestamp_s > self._last_s:
            raise SlamError(
                f"frames must come in the order of time: {frame.timestamp_s:.6f} s after"
                f" {self._last_s:.6f} s"
            )
        wanted = (self._camera.height, self._camera.width)
        if frame.rgb.dtype != np.uint8:
            raise SlamError(
                f"the frame at {frame.timestamp_s:.6f} s has {frame.rgb.dtype} colours, not uint8"
            )
        if frame.rgb.shape != (*wanted, 3) or frame.depth_m.shape != wanted:
            raise SlamError(
                f"the frame at {frame.timestamp_s:.6f} s has colour {frame.rgb.shape} and depth"
                f" {frame.depth_m.shape}, but the camera makes {(*wanted, 3)} and {wanted}"
            )


def _checked_pose(timestamp_s: float, T_odom_cam: FloatArray) -> FloatArray:
    T = np.array(T_odom_cam, dtype=np.float64)  # a copy: callers reuse their matrix
    is_affine = T.shape == (4, 4) and np.isfinite(T).all() and np.allclose(T[3], [0, 0, 0, 1])
    R = T[:3, :3] if is_affine else np.zeros((3, 3))
    if not (np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0.0):
        raise SlamError(
            f"the pose at {timestamp_s:.6f} s is not a rigid (4, 4) transform T_odom_cam"
        )
    return T


def _turning_rad_s(last: Keyframe, timestamp_s: float, T_odom_cam: FloatArray) -> float:
    turned_rad = se3.rotation_angle(se3.inverse(last.T_odom_cam) @ T_odom_cam)
    return float(turned_rad) / (timestamp_s - last.timestamp_s)
