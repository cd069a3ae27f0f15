# SPDX-License-Identifier: Apache-2.0
"""The end of a run: the graph is solved, the map adjusted to it, and every frame to the map."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from placerec.errors import Salvage, cause_of
from slam.evaluation.steps import impossible_steps
from slam.external_odometry.comparison import GivenKeyframe
from slam.external_odometry.odometry import ExternalOdometry
from slam.external_odometry.trust import Trust, Verdict
from slam.loops.atlas import odometry_frames
from slam.loops.back_end import BackEnd, ClosedLoops
from slam.loops.final_map import FinalMap, adjusted, left_as_solved
from slam.loops.saved_map import SavedMap
from slam.loops.stage_clock import StageClock
from slam.mapping.landmark_map import LandmarkMap
from slam.mapping.map_adjustment import size_warning
from slam.result import SlamResult, compared
from slam.system import trajectories
from slam.tracking.frame_log import FrameLog
from slam.tracking.smoothing import smoothed
from slam.tracking.tracker import Tracker
from slam.types import Camera, FloatArray, Keyframe, SlamError, Trajectory

WITHOUT_IMAGES = (
    "this was made of what a run had left, without images and features: the pose graph is solved,"
    " but the map is not adjusted to it, and there are no pictures and no point cloud"
)


@dataclass(frozen=True)
class Finishing:
    """Makes the result of all that a run took in.

    Attributes:
        camera: of the frames.
        tracker: what placed them.
        frames: what became of each.
        back_end: what closed loops between the keyframes.
        external: the odometry from elsewhere, false where there is none.
        earlier: the map that the run went on from, None without.
        is_fixed: whether that stays as it is.
        smooths: whether the trajectory is to be smoothed where the camera was tracked here.
        clock: what counts the time.
    """

    camera: Camera
    tracker: Tracker
    frames: FrameLog
    back_end: BackEnd
    external: ExternalOdometry
    earlier: SavedMap | None
    is_fixed: bool
    smooths: bool
    clock: StageClock

    def finish(self) -> tuple[SlamResult, LandmarkMap | None]:
        """Return what the run found out, and the adjusted map, None where it was not adjusted.

        A part that fails is left out and told in the result's `missing`; the others are there.

        Raises:
            SlamError: no frame could be tracked, or none placed in the earlier map.
            RecognizerError: the recognizer failed on the first keyframe.
        """
        salvage = Salvage()
        left_out = self._wait()
        salvage.attempt("the last keyframe's adjustment", self.tracker.settle, None)
        keyframes = self._tracked()
        read = partial(self._given, keyframes)
        given = salvage.attempt("what the given poses say", read, dict[int, GivenKeyframe]())
        solve = partial(self._solved, keyframes, given)
        loops = salvage.attempt("the solved pose graph", solve, None) or self._unsolved(keyframes)
        adjust = partial(self._adjusted, loops)
        final = salvage.attempt("the map's adjustment", adjust, left_as_solved(loops))
        result = self._placed(keyframes, loops, final)
        steps: dict[str, Callable[[SlamResult], SlamResult]] = {
            "the given odometry, corrected,": partial(self._with_given, loops),
            "how alike the keyframes are": self._with_similarities,
            "the live trajectory": self._with_live,
            "smoothing": self._smoothed,
        }
        for what, step in steps.items():
            result = salvage.attempt(what, partial(step, result), result)
        look = partial(impossible_steps, result.corrected, result.session_starts_s)
        leaps = salvage.attempt("the look for leaps", look, ())
        warnings = (*left_out, *self._warnings(result, loops, final, leaps))
        return replace(result, warnings=warnings, missing=salvage.sentences), final.the_map

    def _wait(self) -> tuple[str, ...]:
        """Wait for the last keyframes, and return what is left out where the recognizer failed.

        Raises:
            SlamError: there is nothing to finish.
            RecognizerError: the recognizer failed on the first keyframe.
        """
        left_out: tuple[str, ...] = ()
        try:
            self.back_end.settle()
        except Exception as error:
            if not self.back_end.keyframes:
                raise
            first = len(self.back_end.keyframes)
            left_out = (f"all from keyframe {first} on is left out: {cause_of(error)}",)
        if self.earlier and self.frames.segment is None:
            raise SlamError(
                "no frame could be placed: none shows enough of the map, or of anything else"
            )
        if not self.back_end.keyframes:
            raise SlamError(
                "no frame could be tracked: none shows enough texture with depth; check the depth"
                " scale and the images, or lower --odometry.min-inliers"
            )
        return left_out

    def _tracked(self) -> tuple[Keyframe, ...]:
        """Return the keyframes where tracking, which knows of no loop, put them in the end."""
        keyframes = tuple(self.back_end.keyframes)
        T_odom_kf = self.tracker.T_odom_kf(each.id for each in keyframes)
        return tuple(replace(each, T_odom_cam=T_odom_kf[each.id]) for each in keyframes)

    def _given(self, keyframes: Sequence[Keyframe]) -> dict[int, GivenKeyframe] | None:
        """Compare an odometry from elsewhere with the images; return where it has keyframes."""
        if not self.external:
            return None
        with self.clock.stage("compare odometry"):
            T_images_kf = self.back_end.solve_images(_T_odom_kf(keyframes))
            tracked = self.frames.tracked(np.array([T_images_kf[each.id] for each in keyframes]))
            return self.external.read(tracked, _stamps_s(keyframes))

    def _solved(
        self, keyframes: Sequence[Keyframe], given: Mapping[int, GivenKeyframe] | None
    ) -> ClosedLoops:
        """Return what the pose graph makes of all loops, of a fixed map what was saved."""
        if self.is_fixed:
            return self._unsolved(keyframes)
        return self.back_end.solve(_T_odom_kf(keyframes), self.frames.per_keyframe(), given)

    def _unsolved(self, keyframes: Sequence[Keyframe]) -> ClosedLoops:
        return self.back_end.unsolved(_T_odom_kf(keyframes))

    def _adjusted(self, loops: ClosedLoops) -> FinalMap:
        """Return the map adjusted to its loops, unless it is fixed, too large, or not there."""
        if self.is_fixed:
            return left_as_solved(loops)
        if too_large := size_warning(len(loops.T_world_kf)):
            return left_as_solved(loops, too_large)
        if self.tracker.map is None:
            return left_as_solved(loops, (WITHOUT_IMAGES,))
        with self.clock.stage("adjust"):
            return adjusted(self.tracker.map, loops)

    def _placed(
        self, keyframes: Sequence[Keyframe], loops: ClosedLoops, final: FinalMap
    ) -> SlamResult:
        """Return where all was, and what stands for the parts that are still to be found out.

        Raises:
            SlamError: no frame has a place in the earlier map.
        """
        frames, T_world_kf = self._along(keyframes, loops.trust), final.T_world_kf
        trajectory = frames.trajectory(T_world_kf)
        if self.earlier and not len(trajectory):
            raise SlamError(
                "no frame could be placed in the map: no loops at two places agree where what was"
                " tracked belongs"
            )
        T_odom_segment = odometry_frames(keyframes, loops.links)
        size = len(compared(len(keyframes)))
        closer = self.back_end.loop_closer
        return SlamResult(
            camera=self.camera,
            keyframes=tuple(
                replace(each, T_odom_cam=T_odom_segment[each.segment] @ each.T_odom_cam)
                for each in keyframes
            ),
            T_world_kf=T_world_kf,
            odometry=self._odometry(T_world_kf, T_odom_segment),
            live=Trajectory(np.zeros(0), np.zeros((0, 4, 4))),
            without_loops=frames.trajectory(final.T_world_kf_without),
            trajectory=trajectory,
            links=loops.links,
            attempts=loops.attempts,
            similarities=np.full((size, size), np.nan, np.float32),
            min_similarity=closer.min_similarity,
            untracked_s=self.frames.untracked_s(T_world_kf),
            stage_seconds=dict(self.clock.seconds),
            warnings=(),
            unjoined_s=self.frames.unjoined_s(T_world_kf),
            session_starts_s=np.array(self.frames.session_starts_s),
            elapsed_s=self.clock.elapsed_s,
            compiling_s=self.clock.compiling_s,
            unsmoothed=trajectory if self._is_smoothed else None,
            threshold=closer.threshold(),
            earlier=len(self.earlier.keyframes) if self.earlier else 0,
        )

    def _along(self, keyframes: Sequence[Keyframe], trust: Trust | None) -> FrameLog:
        """Return the frames, between keyframes as an odometry has them that is borne out."""
        if trust is None or trust.verdict is not Verdict.BORNE_OUT:
            return self.frames
        return self.frames.along(self.external.camera_poses, _stamps_s(keyframes), trust.doubted)

    def _odometry(
        self, T_world_kf: FloatArray, T_odom_segment: Mapping[int, FloatArray]
    ) -> Trajectory:
        """Return placed frames as they were tracked, or as an odometry from elsewhere has them."""
        tracked = trajectories.tracked(self.frames, T_world_kf, T_odom_segment)
        return self.external.before(tracked) if self.external else tracked

    def _with_given(self, loops: ClosedLoops, result: SlamResult) -> SlamResult:
        if not self.external:
            return result
        given = self.external.corrected(result.trajectory, loops.trust, loops.steps)
        return replace(result, given=given)

    def _with_similarities(self, result: SlamResult) -> SlamResult:
        closer = self.back_end.loop_closer
        similarities = closer.similarities()
        calibration = closer.calibration(similarities)
        return replace(result, similarities=similarities, calibration=calibration)

    def _with_live(self, result: SlamResult) -> SlamResult:
        T_given_cam = self.external.poses_as_asked(self.frames.placed_s)
        corrections = self.back_end.corrections
        live = trajectories.live(self.frames, result.T_world_kf, corrections, T_given_cam)
        return replace(result, live=live)

    @property
    def _is_smoothed(self) -> bool:
        # An odometry from elsewhere knows best how its camera moves.
        return self.smooths and not self.external

    def _smoothed(self, result: SlamResult) -> SlamResult:
        if not self._is_smoothed:
            return result
        breaks_s = [*self.frames.session_starts_s, *self.frames.breaks_s()]
        return replace(result, trajectory=smoothed(result.trajectory, breaks_s))

    def _warnings(
        self, result: SlamResult, loops: ClosedLoops, final: FinalMap, leaps: tuple[str, ...]
    ) -> tuple[str, ...]:
        """Return what a user should know before trusting the result, one sentence each."""
        return (
            *(result.given.warnings if result.given else ()),
            *self.frames.warnings(final.T_world_kf),
            *final.warnings,
            *loops.warnings,
            *(result.threshold.warnings if result.threshold else ()),
            *leaps,
            *(result.calibration.warnings if result.calibration else ()),
        )


def _T_odom_kf(keyframes: Sequence[Keyframe]) -> dict[int, FloatArray]:
    return {each.id: each.T_odom_cam for each in keyframes}


def _stamps_s(keyframes: Sequence[Keyframe]) -> FloatArray:
    return np.array([each.timestamp_s for each in keyframes])
