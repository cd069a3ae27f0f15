# SPDX-License-Identifier: Apache-2.0
"""The pipeline in one screen: track, describe, retrieve, verify, constrain, correct."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.certificate import Certificate
from placerec.compiled import load_compiled
from placerec.errors import Salvage, cause_of
from placerec.recognizer import PlaceRecognizer
from slam.config import Config
from slam.evaluation.steps import impossible_steps
from slam.external_odometry.comparison import GivenKeyframe
from slam.external_odometry.odometry import ExternalOdometry
from slam.external_odometry.trust import Verdict
from slam.geometry import se3
from slam.loops.atlas import odometry_frames
from slam.loops.back_end import BackEnd, ClosedLoops
from slam.loops.correction import Correction
from slam.loops.final_adjustment import adjusted
from slam.loops.remembered import Remembered
from slam.loops.saved_map import SavedMap
from slam.loops.stage_clock import StageClock
from slam.mapping.landmark_map import LandmarkMap
from slam.mapping.map_adjustment import size_warning
from slam.result import Calibration, SlamResult, compared
from slam.tracking.frame_checks import check_frame
from slam.tracking.frame_log import FrameLog, LoggedFrames
from slam.tracking.odometry import RgbdOdometry
from slam.tracking.smoothing import smoothed
from slam.tracking.tracked_frame import TrackedFrame
from slam.tracking.tracker import Tracker
from slam.types import (
    Camera,
    FloatArray,
    Frame,
    LoopAttempt,
    Rejection,
    SlamError,
    Trajectory,
)

NOT_ADJUSTED = (
    "this was made of what a run had left, without images and features: the pose graph is solved,"
    " but the map is not adjusted to it, and there are no pictures and no point cloud"
)


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
        self._final: LandmarkMap | None = None  # as adjusted in the end
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
        return not self._back_end.is_empty and (self.earlier is None or self._is_anything_placed)

    @property
    def _is_anything_placed(self) -> bool:
        return self._frames.segment is not None

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
        if T_odom_cam is not None:
            self._refuse_poses()
        if T_odom_cam is None:
            T_given_cam = self._external.at(frame.timestamp_s)
        else:
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
        salvage = Salvage()
        left_out: tuple[str, ...] = ()
        try:
            self._back_end.settle()
        except Exception as error:
            if not self._back_end.keyframes:
                raise
            first = len(self._back_end.keyframes)
            left_out = (f"all from keyframe {first} on is left out: {cause_of(error)}",)
        keyframes = tuple(self._back_end.keyframes)
        if self.earlier and not self._is_anything_placed:
            raise SlamError(
                "no frame could be placed: none shows enough of the map, or of anything else"
            )
        if not keyframes:
            raise SlamError(
                "no frame could be tracked: none shows enough texture with depth; check the depth"
                " scale and the images, or lower --odometry.min-inliers"
            )
        salvage.attempt("the last keyframe's adjustment", self._tracker.settle, None)
        T_odom_kf = self.T_odom_kf
        stamps_s = np.array([each.timestamp_s for each in keyframes])
        given = None
        if self._external:
            given = salvage.attempt(
                "what the given poses say", lambda: self._read_external(T_odom_kf, stamps_s), {}
            )
        loops = salvage.attempt(
            "the solved pose graph",
            lambda: self._solved(T_odom_kf, given),
            None,
        ) or self._back_end.unsolved(T_odom_kf)
        keyframes = tuple(  # where tracking, which knows of no loop, put them in the end
            replace(each, T_odom_cam=T_odom_kf[each.id]) for each in keyframes
        )
        T_odom_segment = odometry_frames(keyframes, loops.links)
        T_world_kf, T_world_kf_without, unadjusted = salvage.attempt(
            "the map's adjustment",
            lambda: self._adjusted(loops),
            (loops.T_world_kf, loops.T_world_kf_without, ()),
        )
        frames = self._frames
        if loops.trust and loops.trust.verdict is Verdict.BORNE_OUT:
            frames = frames.along(self._external.camera_poses, stamps_s, loops.trust.doubted)
        trajectory = frames.trajectory(T_world_kf)
        if self.earlier and not len(trajectory):
            raise SlamError(
                "no frame could be placed in the map: no loops at two places agree where what was"
                " tracked belongs"
            )
        odometry = self._frames.live(
            T_world_kf, lambda frames: _in_one_frame(frames, T_odom_segment)
        )
        result_of_given = None
        if self._external:
            odometry = self._external.before(odometry)
            result_of_given = salvage.attempt(
                "the given odometry, corrected,",
                lambda: self._external.corrected(trajectory, loops.trust, loops.steps),
                None,
            )
        size = len(compared(len(keyframes)))
        similarities, calibration = salvage.attempt(
            "how alike the keyframes are",
            self._similarities,
            (np.full((size, size), np.nan, np.float32), None),
        )
        live = salvage.attempt(
            "the live trajectory",
            lambda: self._live(T_world_kf),
            Trajectory(np.zeros(0), np.zeros((0, 4, 4))),
        )
        smooth = salvage.attempt("smoothing", lambda: self._smoothed(trajectory), trajectory)
        leaps = salvage.attempt(
            "the look for leaps",
            lambda: impossible_steps(trajectory, self._frames.session_starts_s),
            (),
        )
        threshold = self._back_end.loop_closer.threshold()
        return SlamResult(
            camera=self._camera,
            keyframes=tuple(
                replace(each, T_odom_cam=T_odom_segment[each.segment] @ each.T_odom_cam)
                for each in keyframes
            ),
            T_world_kf=T_world_kf,
            odometry=odometry,
            live=live,
            without_loops=frames.trajectory(T_world_kf_without),
            trajectory=smooth,
            links=loops.links,
            attempts=loops.attempts,
            similarities=similarities,
            min_similarity=self.min_similarity,
            untracked_s=self._frames.untracked_s(T_world_kf),
            stage_seconds=dict(self.clock.seconds),
            warnings=(
                *left_out,
                *(result_of_given.warnings if result_of_given else ()),
                *self._frames.warnings(T_world_kf),
                *unadjusted,
                *loops.warnings,
                *(threshold.warnings if threshold else ()),
                *leaps,
                *(calibration.warnings if calibration else ()),
            ),
            calibration=calibration,
            unjoined_s=self._frames.unjoined_s(T_world_kf),
            session_starts_s=np.array(self._frames.session_starts_s),
            elapsed_s=self.clock.elapsed_s,
            unsmoothed=trajectory if self._is_smoothed else None,
            given=result_of_given,
            missing=salvage.sentences,
            threshold=threshold,
            earlier=len(self.earlier.keyframes) if self.earlier else 0,
        )

    def _solved(
        self, T_odom_kf: Mapping[int, FloatArray], given: Mapping[int, GivenKeyframe] | None
    ) -> ClosedLoops:
        if self._is_fixed:  # as it was saved
            return self._back_end.unsolved(T_odom_kf)
        return self._back_end.solve(T_odom_kf, self._frames.per_keyframe(), given)

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
            RecognizerError: the recognizer has neither a fingerprint nor a source file.
        """
        if self.earlier and self._is_fixed:
            return self.earlier
        the_map = self._final or self._tracker.map
        assert the_map is not None  # or it is a run without images, of which none is saved
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

    def _adjusted(self, loops: ClosedLoops) -> tuple[FloatArray, FloatArray, tuple[str, ...]]:
        """Return the (K, 4, 4) poses by the adjusted map, with loops and without, and warnings.

        Where the map is too large, which is told, they are those of the pose graph.
        """
        self._final = None
        if self._is_fixed:
            return loops.T_world_kf, loops.T_world_kf_without, ()
        if warnings := size_warning(len(loops.T_world_kf)):
            return loops.T_world_kf, loops.T_world_kf_without, warnings
        if self._tracker.map is None:
            return loops.T_world_kf, loops.T_world_kf_without, (NOT_ADJUSTED,)
        with self.clock.stage("adjust"):
            *T_kf, self._final = adjusted(self._tracker.map, loops)
            return T_kf[0], T_kf[1], ()

    def _similarities(self) -> tuple[NDArray[np.float32], Calibration | None]:
        closer = self._back_end.loop_closer
        similarities = closer.similarities()
        return similarities, closer.calibration(similarities)

    def _read_external(
        self, T_odom_kf: dict[int, FloatArray], stamps_s: FloatArray
    ) -> dict[int, GivenKeyframe]:
        """Compare another odometry with the images; return where it has keyframes, by id."""
        with self.clock.stage("compare odometry"):
            T_images_kf = self._back_end.solve_images(T_odom_kf)
            tracked = self._frames.tracked(np.array([T_images_kf[k] for k in sorted(T_odom_kf)]))
            return self._external.read(tracked, stamps_s)

    def _live(self, T_world_kf: FloatArray) -> Trajectory:
        """Return where the placed frames were thought to be, in the world, when they came."""
        corrections = self._back_end.corrections
        T_given_cam = self._external.poses_as_asked(self._frames.placed_s)

        newest_ids = np.array([each.newest_id for each in corrections])

        def T_world_cam(frames: LoggedFrames) -> FloatArray:
            T = np.full((len(frames.timestamps_s), 4, 4), np.nan)
            known = np.searchsorted(newest_ids, frames.newest_id, side="right") - 1
            for number in np.unique(known):
                correction, some = corrections[number], known == number
                T[some] = _in_one_frame(frames.select(some), correction.T_world_odom)
                if T_given_cam and correction.T_world_given is not None:
                    for n in np.flatnonzero(some):
                        T_odom_cam = T_given_cam.get(float(frames.timestamps_s[n]))
                        if T_odom_cam is not None:
                            T[n] = correction.T_world_given @ T_odom_cam
            return T

        return self._frames.live(T_world_kf, T_world_cam)

    @property
    def _is_smoothed(self) -> bool:
        # An odometry from elsewhere knows best how its camera moves.
        return self._config.motion.smooth and not self._external

    def _smoothed(self, trajectory: Trajectory) -> Trajectory:
        if not self._is_smoothed:
            return trajectory
        return smoothed(trajectory, [*self._frames.session_starts_s, *self._frames.breaks_s()])


def _in_one_frame(frames: LoggedFrames, T_any_odom: Mapping[int, FloatArray]) -> FloatArray:
    """Return the (N, 4, 4) poses of frames as tracked, NaN for segments that are not known."""
    T = np.full((len(frames.timestamps_s), 4, 4), np.nan)
    for segment, T_any_segment in T_any_odom.items():
        some = frames.segment == segment
        T[some] = T_any_segment @ frames.T_odom_cam[some]
    return T
