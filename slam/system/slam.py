# SPDX-License-Identifier: Apache-2.0
"""The pipeline in one screen: track, describe, retrieve, verify, constrain, correct."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from placerec.certificate import Certificate
from placerec.compiled import load_compiled
from placerec.recognizer import PlaceRecognizer
from slam.config import Config
from slam.external_odometry.odometry import ExternalOdometry
from slam.geometry import se3
from slam.loops.back_end import BackEnd
from slam.loops.correction import Correction
from slam.loops.remembered import Remembered
from slam.loops.saved_map import SavedMap
from slam.loops.stage_clock import StageClock
from slam.mapping.landmark_map import LandmarkMap
from slam.result import SlamResult
from slam.system.finishing import Finishing
from slam.tracking.frame_checks import check_frame
from slam.tracking.frame_log import FrameLog
from slam.tracking.odometry import RgbdOdometry
from slam.tracking.tracked_frame import TrackedFrame
from slam.tracking.tracker import Tracker
from slam.types import Camera, FloatArray, Frame, LoopAttempt, Rejection, SlamError


class Slam:
    """RGB-D SLAM with loop closure, for a camera alone or for one that an odometry has poses of.

    `process(frame)` takes the images one by one, `process(frame, T_odom_cam)` with the pose that
    any other odometry has of the camera. How good that is, is found out by comparing the two.
    `finish()` returns the result.
    """

    def __init__(
        self,
        camera: Camera,
        recognizer: PlaceRecognizer,
        config: Config | None = None,
        scratch: Path | None = None,
        earlier: SavedMap | None = None,
        is_fixed: bool = False,
    ) -> None:
        """Begin, with the default settings unless told.

        What does not fit into memory goes to a file without a name in the folder `scratch`, by
        default the system's for temporary files. An earlier map is gone on from, and taken over:
        load it anew for another run. Its frame is the world. A fixed one is not extended: the
        camera is placed where it shows what the camera sees, and nowhere else. Another camera may
        have made it.
        """
        load_compiled()
        self._camera = camera
        self._config = config or Config()
        self.clock = StageClock()
        self._back_end = BackEnd(camera, recognizer, self._config, self.clock)
        odometry = RgbdOdometry(camera, self._config, self._back_end.recognize, scratch)
        self._tracker: Tracker = odometry
        self._external = ExternalOdometry(self._config.odometry)
        self._frames = FrameLog(earlier.frames.tolist() if earlier else ())
        self.earlier = earlier
        self._is_fixed = is_fixed
        if earlier is not None:
            self._back_end.load(earlier)
            odometry.load(earlier.keyframes, earlier.the_map, is_fixed)
        self._adjusted_map: LandmarkMap | None = None  # in the end
        # Where another odometry's frame is in that of tracking, by the last frame that had a pose;
        # and the map, which lies where it had the first one.
        self._T_odom_given: FloatArray | None = None
        self._T_map_world: FloatArray | None = None

    @property
    def attempts(self) -> Sequence[LoopAttempt]:
        """The loop candidates so far, in the order they were looked at, before they are weighed."""
        return self._back_end.attempts

    @property
    def min_similarity(self) -> float:
        """The similarity from which loop candidates are verified now."""
        return self._back_end.loop_closer.min_similarity

    @property
    def has_keyframes(self) -> bool:
        """Whether there is anything to finish."""
        is_placed = self.earlier is None or self._frames.segment is not None
        return is_placed and not self._back_end.is_empty

    def process(
        self,
        frame: Frame,
        T_odom_cam: FloatArray | None = None,
        covariance: FloatArray | None = None,
    ) -> TrackedFrame | Rejection:
        """Take the next frame of the camera and return where it was placed, or why it was not.

        Another odometry may have a (4, 4) pose of the camera, or of the body that it is on: see
        `--odometry.T-base-cam`. If it tells the (6, 6) covariance of its motion since its last
        pose, [rotation; translation], that is believed; else it is estimated.

        Raises:
            SlamError: the frame is not of the camera's size, the time does not increase, or the
                pose is not a rigid transform.
            RecognizerError: the recognizer failed on a keyframe, up to eight before this one, or on
                this frame, where the camera was lost; what was done until then can be finished.
        """
        return self._process(frame, T_odom_cam, covariance, is_keyframe=False)

    def add_pose(
        self, timestamp_s: float, T_odom_cam: FloatArray, covariance: FloatArray | None = None
    ) -> None:
        """Take a pose of another odometry at a time without an image, as in `process`.

        It is corrected like the others, and tells where the camera went between two images.

        Raises:
            SlamError: the pose is not a rigid transform, or its time is not after the last one's.
        """
        self._refuse_poses()
        self._external.add(timestamp_s, T_odom_cam, covariance)

    def _refuse_poses(self) -> None:
        if self.earlier:
            raise SlamError("poses of another odometry cannot be used together with an earlier map")

    @property
    def time_offset_s(self) -> float:
        """How much later the poses' time stamps are than the images', as far as is set."""
        return self._external.time_offset_s

    def start_session(self) -> None:
        """Take the next frame for the first of another recording, which may begin anywhere.

        Loops tell how the sessions lie to each other. The camera stays the same, and time goes on.
        """
        self._frames.start_session()
        self._tracker.start_session()
        self._external.start_session()

    def add_keyframe(self, frame: Frame, T_odom_cam: FloatArray) -> tuple[LoopAttempt, ...]:
        """Take a frame that has to be a keyframe, as in `process`, and return its loop candidates.

        There are none of a frame that shows too little to become one.

        Raises:
            SlamError: the frame is not of the camera's size, the time does not increase, or the
                pose is not a rigid transform.
            RecognizerError: the recognizer failed; what was done until then can be finished.
        """
        tracked = self._process(frame, T_odom_cam, None, is_keyframe=True)
        attempts = self._back_end.settle()
        return () if isinstance(tracked, Rejection) else attempts

    def _process(
        self,
        frame: Frame,
        T_odom_cam: FloatArray | None,
        covariance: FloatArray | None,
        is_keyframe: bool,
    ) -> TrackedFrame | Rejection:
        check_frame(frame, self._camera, self._frames.last_s)
        if T_odom_cam is None:
            T_given_cam = self._external.at(frame.timestamp_s)
        else:
            self._refuse_poses()
            T_given_cam = self._external.add(frame.timestamp_s, T_odom_cam, covariance)
        self._frames.expect(frame.timestamp_s)
        with self.clock.stage("track"):
            tracked = self._tracker.track(frame, T_given_cam, is_keyframe)
        if isinstance(tracked, Rejection):
            self._frames.lose(frame.timestamp_s)
            return tracked
        if keyframe := tracked.new_keyframe:
            given = self._external.next_keyframe(keyframe.timestamp_s, T_given_cam)
            self._back_end.insert(keyframe, tracked.links, tracked.moved, frame.rgb, given)
        self._frames.add(frame.timestamp_s, tracked)
        if T_given_cam is not None:
            self._T_odom_given = tracked.T_odom_cam @ se3.inverse(T_given_cam)
            T_world_odom = self.correction.T_world_odom.get(tracked.segment)
            if self._T_map_world is None and T_world_odom is not None:
                self._T_map_world = se3.inverse(T_world_odom @ self._T_odom_given)
        return tracked

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

        The odometry is what `process` returns; for poses from elsewhere ask `T_map_odom`.

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

    def T_map_odom(self) -> FloatArray:
        """Return the (4, 4) correction of another odometry's poses as of now, without waiting.

        The map lies where that odometry began, and `T_map_odom @ T_odom_cam` is where the camera
        is. While the images bear the odometry out the correction changes when loops are closed;
        where they contradict it they are followed, and it changes with every frame.

        Raises:
            SlamError: no frame had a pose yet, or nothing tells where the camera is since it was
                lost or a session began.
        """
        if self._T_map_world is None or self._T_odom_given is None:
            raise SlamError("there is no frame with a pose yet that could be corrected")
        T_world_given = self.correction.T_world_given
        if T_world_given is None:
            T_world_given = self.T_world_odom() @ self._T_odom_given
        return np.asarray(self._T_map_world @ T_world_given)

    def settle(self) -> None:
        """Wait until all keyframes are taken in and `correction` knows of their loops.

        Raises:
            RecognizerError: the recognizer failed on one; what was done until then can be finished.
        """
        self._back_end.catch_up()

    def finish(self) -> SlamResult:
        """Solve the graph with all loops, adjust the map to it, and return what the run found out.

        A part that fails is left out and told in the result's `missing`; the others are there.

        Raises:
            SlamError: no frame could be tracked.
            RecognizerError: the recognizer failed on the first keyframe.
        """
        finishing = Finishing(
            camera=self._camera,
            tracker=self._tracker,
            frames=self._frames,
            back_end=self._back_end,
            external=self._external,
            earlier=self.earlier,
            is_fixed=self._is_fixed,
            smooths=self._config.motion.smooth,
            clock=self.clock,
        )
        result, self._adjusted_map = finishing.finish()
        return result

    @property
    def T_odom_kf(self) -> dict[int, FloatArray]:
        """Where tracking, which knows of no loop, put keyframes in the end: (4, 4) by id."""
        return self._tracker.T_odom_kf(each.id for each in self._back_end.keyframes)

    @property
    def certificate(self) -> Certificate | None:
        """What the recognizer was calibrated on, None where nobody says so."""
        return self._back_end.loop_closer.certificate

    @property
    def remembered(self) -> Remembered | None:
        """What deciding about loops again takes, once the run is finished; None of too many."""
        the_map = self._tracker.map
        return self._back_end.loop_closer.remembered(the_map) if the_map else None

    def saved(self, result: SlamResult) -> SavedMap:
        """Return the map of a finished run for later ones: the keyframes that have a place.

        Raises:
            SlamError: the run was finished without its images.
            RecognizerError: the recognizer has neither a fingerprint nor a source file.
        """
        if self.earlier and self._is_fixed:
            return self.earlier
        the_map = self._adjusted_map or self._tracker.map
        if the_map is None:
            raise SlamError("a run that was finished without its images has no map to save")
        earlier = self.earlier.sessions if self.earlier else np.zeros(0, np.int64)
        stamps_s = [each.timestamp_s for each in result.keyframes[len(earlier) :]]
        later = np.searchsorted(self._frames.session_starts_s, stamps_s, side="right")
        later += 1 + earlier.max(initial=-1)
        return self._back_end.saved(
            result.T_world_kf,
            result.attempts,
            result.links,
            np.concatenate([earlier, later]),
            self._frames.per_keyframe(),
            the_map,
        )
