# SPDX-License-Identifier: Apache-2.0
"""An odometry from elsewhere during a run: its poses come in, are read, judged and corrected."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam.config import OdometryConfig
from slam.external_odometry.advice import Reading, asked_convention, judgement, read
from slam.external_odometry.calibration import calibrate, with_parts
from slam.external_odometry.comparison import GivenKeyframe
from slam.external_odometry.given_poses import GivenPoses, poses_between
from slam.external_odometry.trust import Trust
from slam.geometry import se3
from slam.result import GivenOdometry
from slam.types import FloatArray, Link, SlamError, Trajectory

_AHEAD_S = 0.05  # for which the last motion is taken to go on


def checked_pose(timestamp_s: float, T_odom_cam: FloatArray) -> FloatArray:
    """Return a copy of a pose, since callers reuse their matrix.

    Raises:
        SlamError: it is not a rigid (4, 4) transform.
    """
    T = np.array(T_odom_cam, dtype=np.float64)
    is_affine = T.shape == (4, 4) and np.isfinite(T).all() and np.allclose(T[3], [0, 0, 0, 1])
    R = T[:3, :3] if is_affine else np.zeros((3, 3))
    if not (np.allclose(R @ R.T, np.eye(3), atol=1e-6) and np.linalg.det(R) > 0.0):
        raise SlamError(
            f"the pose at {timestamp_s:.6f} s is not a rigid (4, 4) transform T_odom_cam"
        )
    return T


class ExternalOdometry:
    """The poses of an odometry from elsewhere; false while there are none."""

    def __init__(self, config: OdometryConfig) -> None:
        self._config = config
        self._given = GivenPoses()
        self._asked = asked_convention(config)
        self._reading = Reading(self._asked)
        self._last_keyframe_s = -np.inf
        self._is_new_session = False
        self._new_sessions_s: list[float] = []
        self._stamps_s: dict[int, float] = {}

    def __bool__(self) -> bool:
        return len(self._given) > 0

    @property
    def time_offset_s(self) -> float:
        """How much later the time stamps are than the images', as was asked for."""
        return self._asked.time_offset_s

    def start_session(self) -> None:
        """Take the next pose for the first of another recording's odometry."""
        self._is_new_session = bool(self)

    def add(
        self, timestamp_s: float, T_odom_body: FloatArray, covariance: FloatArray | None
    ) -> FloatArray:
        """Take a (4, 4) pose and return the camera's, read as was asked for.

        Raises:
            SlamError: it is not rigid, its time is not after the last one's, or the covariance is
                not that of a motion.
        """
        T_odom_body = checked_pose(timestamp_s, T_odom_body)
        if not self._given.last_s < timestamp_s < np.inf:
            raise SlamError(
                f"poses must come in the order of time: {timestamp_s:.6f} s after"
                f" {self._given.last_s:.6f} s"
            )
        if covariance is not None:
            covariance = _checked_covariance(timestamp_s, covariance)
        self._given.add(timestamp_s, T_odom_body, covariance)
        if self._is_new_session:
            self._new_sessions_s.append(timestamp_s)
            self._is_new_session = False
        one = Trajectory(np.array([timestamp_s]), T_odom_body[None])
        return np.asarray(self._asked.camera_poses(one).T_world_cam[0])

    def at(self, timestamp_s: float) -> FloatArray | None:
        """Return where the odometry has the camera at a time, or just after its last pose.

        That is (4, 4), read as was asked for, and None where it has no pose around then.
        """
        around = self._given.around(timestamp_s + self.time_offset_s)
        known = self._asked.camera_poses(around)
        if len(known) < 2:
            return None
        T = poses_between(known, np.array([timestamp_s]))[0]
        if np.isfinite(T[0, 0]):
            return np.asarray(T)
        first_s, last_s = known.timestamps_s
        ahead = (timestamp_s - last_s) / (last_s - first_s)
        if not 0.0 < ahead <= 1.0 or timestamp_s - last_s > _AHEAD_S:
            return None
        step = se3.log(se3.inverse(known.T_world_cam[0]) @ known.T_world_cam[1])
        return np.asarray(known.T_world_cam[1] @ se3.exp(ahead * step))

    def next_keyframe(
        self, timestamp_s: float, T_given_cam: FloatArray | None
    ) -> GivenKeyframe | None:
        """Return what a keyframe is told of where the odometry has it, None where it has not."""
        if T_given_cam is None:
            return None
        start_s, self._last_keyframe_s = self._last_keyframe_s, timestamp_s
        offset_s = self.time_offset_s
        return self._keyframe(start_s + offset_s, timestamp_s + offset_s, T_given_cam)

    def _keyframe(self, start_s: float, end_s: float, T_given_cam: FloatArray) -> GivenKeyframe:
        is_new = any(start_s < each <= end_s for each in self._new_sessions_s)
        covariance = self._given.covariance(start_s, end_s)
        return GivenKeyframe(T_given_cam, covariance, is_new, not self._given.is_at(end_s))

    def read(
        self, tracked: Sequence[Trajectory], keyframe_s: FloatArray
    ) -> dict[int, GivenKeyframe]:
        """Find out what the poses are of; return where they have keyframes at (K,) times, by id.

        What was tracked are the frames of each segment, in a frame of its own.
        """
        if not self:
            return {}
        given, asked = self._given.trajectory, self._asked
        if found := calibrate(tracked, given, asked):
            found = with_parts(found, tracked, given, asked)
        self._reading = read(self._config, found)
        self._stamps_s = dict(enumerate(keyframe_s.tolist()))
        if not self._reading.fits:
            return {}
        keyframes, start_s = {}, -np.inf
        offset_s = self._reading.convention.time_offset_s
        for k, T in enumerate(poses_between(self.camera_poses, keyframe_s)):
            if np.isfinite(T[0, 0]):
                end_s = float(keyframe_s[k])
                keyframes[k] = self._keyframe(start_s + offset_s, end_s + offset_s, T)
                start_s = end_s
        return keyframes

    @property
    def camera_poses(self) -> Trajectory:
        """The camera's poses at the images' times, as the given ones are read by now."""
        return self._reading.convention.camera_poses(self._given.trajectory)

    def poses_as_asked(self, stamps_s: FloatArray) -> dict[float, FloatArray]:
        """Return the camera's (4, 4) poses by time as they were known during the run."""
        if not self:
            return {}
        known = self._asked.camera_poses(self._given.trajectory)
        poses = zip(stamps_s.tolist(), poses_between(known, stamps_s), strict=True)
        return {time_s: T for time_s, T in poses if np.isfinite(T[0, 0])}

    def before(self, tracked: Trajectory) -> Trajectory:
        """Return the camera's poses at the times of tracked frames, as far as they are known."""
        T = poses_between(self.camera_poses, tracked.timestamps_s)
        known = np.isfinite(T[:, 0, 0])
        return Trajectory(tracked.timestamps_s[known], T[known])

    def corrected(
        self, trajectory: Trajectory, trust: Trust | None, steps: tuple[Link, ...]
    ) -> GivenOdometry:
        """Return what became of the poses, by the corrected trajectory of the frames.

        The steps are those that the pose graph was given.
        """
        given, convention = self._given.trajectory, self._reading.convention
        camera = self.camera_poses
        T_world_cam = carried(camera, trajectory)
        known = np.isfinite(T_world_cam[:, 0, 0])
        T_world_cam, T_odom_cam = T_world_cam[known], camera.T_world_cam[known]
        if known.any():  # where the first one is, it stays
            T_world_cam = T_odom_cam[0] @ se3.inverse(T_world_cam[0]) @ T_world_cam
        corrected = convention.as_given(Trajectory(camera.timestamps_s[known], T_world_cam))
        verdict, doubts = judgement(trust, self._stamps_s) if trust else ("", ())
        return GivenOdometry(
            given,
            replace(corrected, timestamps_s=given.timestamps_s[known]),
            T_world_cam @ se3.inverse(T_odom_cam),
            verdict,
            (*self._reading.sentences, *doubts),
            steps,
            self._reading.fits,
        )


def _checked_covariance(timestamp_s: float, covariance: FloatArray) -> FloatArray:
    covariance = np.array(covariance, dtype=np.float64)
    is_right = covariance.shape == (6, 6) and np.isfinite(covariance).all()
    if not is_right or np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise SlamError(
            f"the covariance of the pose at {timestamp_s:.6f} s is not a positive definite (6, 6)"
            " matrix"
        )
    return covariance


def carried(given: Trajectory, corrected: Trajectory) -> FloatArray:
    """Return the (N, 4, 4) poses that given ones have once frames of the same camera are corrected.

    Between two frames the odometry says how the camera moved, and what that is off at the second is
    shared out in proportion to time; before the first and after the last it is believed.
    """
    T_given = poses_between(given, corrected.timestamps_s)
    known = np.isfinite(T_given[:, 0, 0])
    if not known.any():
        return np.full((len(given), 4, 4), np.nan)
    stamps_s, T_given = corrected.timestamps_s[known], T_given[known]
    T = corrected.T_world_cam[known]
    right = np.searchsorted(stamps_s, given.timestamps_s, side="right")
    before, after = np.clip(right - 1, 0, None), np.clip(right, None, len(stamps_s) - 1)
    gap_s = stamps_s[after] - stamps_s[before]
    since_s = np.clip(given.timestamps_s - stamps_s[before], 0.0, gap_s)
    share = np.divide(since_s, gap_s, out=np.zeros(len(given)), where=gap_s > 0.0)
    # Where the second frame would be by the odometry alone, and how that is off, seen from there.
    T_expected = T[before] @ se3.inverse(T_given[before]) @ T_given[after]
    bend = se3.log(se3.inverse(T_expected) @ T[after])
    T_after_here = se3.inverse(T_given[after]) @ given.T_world_cam
    return np.asarray(T_expected @ se3.exp(share[:, None] * bend) @ T_after_here)
