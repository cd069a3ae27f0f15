# SPDX-License-Identifier: Apache-2.0
"""The pipeline in one screen: track, describe, retrieve, verify, constrain, correct."""

from bisect import bisect_right
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from placerec.errors import RecognizerError
from placerec.recognizer import PlaceRecognizer
from slam.config import Config
from slam.evaluation.steps import impossible_steps
from slam.loops.atlas import Correction, odometry_frames
from slam.loops.back_end import BackEnd, ClosedLoops
from slam.mapping.landmark_map import LandmarkMap
from slam.mapping.map_adjustment import adjust_with_loops, size_warning
from slam.result import SlamResult
from slam.stage_clock import StageClock
from slam.tracking.frame_log import FrameLog, check_frame, checked_pose
from slam.tracking.given_poses import GivenPoses
from slam.tracking.odometry import RgbdOdometry
from slam.tracking.smoothing import smoothed
from slam.tracking.tracked_frame import TrackedFrame
from slam.types import Camera, FloatArray, Frame, LoopAttempt, Rejection, SlamError, Trajectory


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
        self.clock = StageClock()
        self._back_end = BackEnd(camera, recognizer, self._config, self.clock)
        self._odometry = RgbdOdometry(camera, self._config, self._back_end.recognize)
        self._given_poses = GivenPoses(camera, self._config)
        self._front_end: RgbdOdometry | GivenPoses = self._odometry  # where frames come through
        self._frames = FrameLog()
        self._last_s = -np.inf  # of the last frame
        self._is_new_session = False
        self._session_starts_s: list[float] = []

    @property
    def has_keyframes(self) -> bool:
        """Whether there is anything to finish."""
        return not self._back_end.is_empty

    def process(self, frame: Frame) -> TrackedFrame | Rejection:
        """Take the next frame of the camera and return where it was placed, or why it was not.

        Raises:
            SlamError: the frame is not of the camera's size, or the time does not increase.
            RecognizerError: the recognizer failed on a keyframe, up to eight before this one, or on
                this frame, where the camera was lost; what was done until then can be finished.
        """
        check_frame(frame, self._camera, self._last_s)
        self._enter(self._odometry, frame)
        with self.clock.stage("track"):
            tracked = self._odometry.track(frame)
        self._take(frame, tracked)
        return tracked

    def start_session(self) -> None:
        """Take the next frame for the first of another recording, which may begin anywhere.

        Loops tell how the sessions lie to each other. The camera stays the same, and time goes on.
        """
        self._is_new_session = self._last_s > -np.inf
        self._odometry.start_session()
        self._given_poses.start_session()

    def add_keyframe(self, frame: Frame, T_odom_cam: FloatArray) -> tuple[LoopAttempt, ...]:
        """Take a keyframe whose (4, 4) pose comes from elsewhere and return its loop candidates.

        Raises:
            SlamError: the frame is not of the camera's size, the time does not increase, or the
                pose is not a rigid transform.
            RecognizerError: the recognizer failed; what was done until then can be finished.
        """
        T_odom_cam = checked_pose(frame.timestamp_s, T_odom_cam)
        check_frame(frame, self._camera, self._last_s)
        self._enter(self._given_poses, frame)
        self._take(frame, self._given_poses.track(frame, T_odom_cam))
        return self._back_end.settle()

    def _enter(self, front_end: RgbdOdometry | GivenPoses, frame: Frame) -> None:
        if self._last_s > -np.inf and front_end is not self._front_end:
            doors = ("process", "add_keyframe")
            begun, other = doors if self._front_end is self._odometry else doors[::-1]
            raise SlamError(f"this run goes through {begun}; start another Slam for {other}")
        self._front_end, self._last_s = front_end, frame.timestamp_s
        if self._is_new_session:
            self._session_starts_s.append(frame.timestamp_s)
            self._is_new_session = False

    def _take(self, frame: Frame, tracked: TrackedFrame | Rejection) -> None:
        if isinstance(tracked, Rejection):
            self._frames.lose(frame.timestamp_s)
            return
        if tracked.new_keyframe:
            self._back_end.insert(tracked.new_keyframe, tracked.links, tracked.moved, frame.rgb)
        self._frames.add(frame.timestamp_s, tracked)

    @property
    def correction(self) -> Correction:
        """The newest correction by loops, a snapshot that is there without waiting.

        It comes from a thread beside tracking, some tenths of a second after the loops that it
        knows of, and has a version. `correction.T_world_odom[segment] @ tracked.T_odom_cam` places
        a frame in the corrected world; whoever needs poses without jumps keeps the correction that
        the poses before were placed by.
        """
        return self._back_end.corrections[-1]

    def T_world_odom(self) -> FloatArray:
        """Return the (4, 4) correction as of now: from the odometry's frame to the world.

        Raises:
            SlamError: there is no keyframe yet, or nothing tells where the camera is since it was
                lost or a session began.
        """
        segment = self._frames.segment
        if segment is None:
            raise SlamError("there is no keyframe yet that a correction could be known of")
        T_world_odom = self.correction.T_world_odom.get(segment)
        if T_world_odom is None:
            raise SlamError(
                "the camera was lost or began a new session, and so far no loops at two places"
                " agree where the part of the map that it is in lies to the rest; ask again later"
            )
        return T_world_odom

    def settle(self) -> None:
        """Wait until all keyframes are taken in and `correction` knows of their loops.

        Raises:
            RecognizerError: the recognizer failed on one; what was done until then can be finished.
        """
        self._back_end.catch_up()

    def finish(self) -> SlamResult:
        """Solve the graph with all loops, adjust the map to it, and return what the run found out.

        Raises:
            SlamError: no frame could be tracked.
            RecognizerError: the recognizer failed on the first keyframe.
        """
        left_out: tuple[str, ...] = ()
        try:
            self._back_end.settle()
        except RecognizerError as error:
            if not self._back_end.keyframes:
                raise
            first = len(self._back_end.keyframes)
            left_out = (f"all from keyframe {first} on is left out: {error}",)
        keyframes = tuple(self._back_end.keyframes)
        if not keyframes:
            raise SlamError(
                "no frame could be tracked: none shows enough texture with depth; check the depth"
                " scale and the images, or lower --odometry.min-inliers"
            )
        T_odom_kf: dict[int, FloatArray] = {}
        if self._front_end is self._odometry:
            self._odometry.settle()
            T_odom_kf = {k.id: self._odometry.map.keyframes[k.id].T_map_cam for k in keyframes}
        loops = self._back_end.solve(T_odom_kf, self._frames.per_keyframe())
        keyframes = tuple(  # where tracking, which knows of no loop, put them in the end
            replace(each, T_odom_cam=T_odom_kf.get(each.id, each.T_odom_cam)) for each in keyframes
        )
        T_odom_segment = odometry_frames(keyframes, loops.links)
        T_world_kf, T_world_kf_without = loops.T_world_kf, loops.T_world_kf_without
        unadjusted: tuple[str, ...] = ()
        if self._front_end is self._odometry:
            unadjusted = size_warning(len(keyframes))
            if not unadjusted:
                with self.clock.stage("adjust"):
                    T_world_kf, T_world_kf_without = _adjusted(self._odometry.map, loops)
        corrections = self._back_end.corrections

        def T_world_odom(segment: int, newest_id: int) -> FloatArray | None:
            known = bisect_right(corrections, newest_id, key=lambda each: each.newest_id)
            return corrections[known - 1].T_world_odom.get(segment)

        trajectory = self._frames.trajectory(T_world_kf)
        loop_closer = self._back_end.loop_closer
        calibration = loop_closer.calibration()
        return SlamResult(
            camera=self._camera,
            keyframes=tuple(
                replace(each, T_odom_cam=T_odom_segment[each.segment] @ each.T_odom_cam)
                for each in keyframes
            ),
            T_world_kf=T_world_kf,
            odometry=self._frames.live(T_world_kf, lambda segment, _: T_odom_segment[segment]),
            live=self._frames.live(T_world_kf, T_world_odom),
            without_loops=self._frames.trajectory(T_world_kf_without),
            trajectory=self._smoothed(trajectory),
            links=loops.links,
            attempts=loops.attempts,
            similarities=self._back_end.similarities(),
            min_similarity=loop_closer.min_similarity,
            untracked_s=self._frames.untracked_s(T_world_kf),
            stage_seconds=dict(self.clock.seconds),
            warnings=(
                *left_out,
                *self._frames.warnings(T_world_kf),
                *unadjusted,
                *loops.warnings,
                *impossible_steps(trajectory, self._session_starts_s),
                *(calibration.warnings if calibration else ()),
            ),
            calibration=calibration,
            unjoined_s=self._frames.unjoined_s(T_world_kf),
            session_starts_s=np.array(self._session_starts_s),
            elapsed_s=self.clock.elapsed_s,
            unsmoothed=trajectory if self._is_smoothed else None,
        )

    @property
    def _is_smoothed(self) -> bool:
        # An odometry from elsewhere knows best how its camera moves.
        return self._config.motion.smooth and self._front_end is self._odometry

    def _smoothed(self, trajectory: Trajectory) -> Trajectory:
        if not self._is_smoothed:
            return trajectory
        return smoothed(trajectory, [*self._session_starts_s, *self._frames.breaks_s()])


def _adjusted(the_map: LandmarkMap, loops: ClosedLoops) -> tuple[FloatArray, FloatArray]:
    """Return the (K, 4, 4) poses to which the map brings what it begins with, NaN as there.

    That is the loops' solution, and the odometry's, which is adjusted in the same way but for
    loops; the two do not wait for each other.
    """
    pairs = [(each.match_id, each.query_id) for each in loops.attempts if each.rejection is None]
    placed = np.flatnonzero(np.isfinite(loops.T_world_kf[:, 0, 0])).tolist()

    def adjusted(T_start_kf: FloatArray, pairs: list[tuple[int, int]]) -> FloatArray:
        T_world_kf = T_start_kf.copy()
        final = adjust_with_loops(the_map, placed, T_start_kf[placed], pairs)
        T_world_kf[placed] = [final.keyframes[k].T_map_cam for k in placed]
        return T_world_kf

    with ThreadPoolExecutor(1, thread_name_prefix="without loops") as beside:
        without = beside.submit(adjusted, loops.T_world_kf_without, [])
        T_world_kf = adjusted(loops.T_world_kf, pairs) if pairs else without.result()
        return T_world_kf, without.result()
