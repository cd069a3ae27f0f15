# SPDX-License-Identifier: Apache-2.0
"""The values that travel between the stages; all frozen, and without algorithms."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from placerec.errors import LoopcloseError

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

PREVIEW_SCALE = 0.5
"""Size of a keyframe's preview, of its frame's."""


class SlamError(LoopcloseError):
    """A problem with a recording, a pose or a setting that the user can solve."""


@dataclass(frozen=True)
class Camera:
    """A pinhole RGB-D camera whose depth image is registered to its colour image.

    Attributes:
        width, height: image size, pixels.
        fx, fy, cx, cy: focal lengths and principal point, pixels.
        distortion: k1, k2, p1, p2, k3 of OpenCV's (Brown-Conrady) model; zeros for none.
        depth_scale: depth image units per metre (5000 in the TUM RGB-D benchmark).
        readout_s: between the first row's exposure and the last's; 0 for a global shutter.
        depth_noise_m: standard deviation of the depth at 1 m; it grows with the square of depth.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    depth_scale: float = 5000.0
    readout_s: float = 0.0
    depth_noise_m: float = 0.0025

    @property
    def matrix(self) -> FloatArray:
        """The (3, 3) intrinsic matrix, pixels."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def preview_shape(self) -> tuple[int, int]:
        """Height and width of an image at `PREVIEW_SCALE`, pixels."""
        return self.height // 2, self.width // 2


@dataclass(frozen=True)
class Frame:
    """One RGB-D image.

    Attributes:
        timestamp_s: seconds, strictly increasing along a sequence.
        rgb: (H, W, 3) uint8.
        depth_m: (H, W) float32, metres along the optical axis, 0 where unknown.
    """

    timestamp_s: float
    rgb: NDArray[np.uint8]
    depth_m: NDArray[np.float32]


@dataclass(frozen=True)
class Features:
    """ORB features of one frame.

    Attributes:
        pixels: (N, 2) float32, where each was seen in the (distorted) image.
        undistorted_px: (N, 2) float32, without what lens and rolling shutter do.
        octaves: (N,) uint8, pyramid level: a feature's pixel noise grows with it.
        descriptors: (N, 32) uint8.
        depth_m: (N,) float32, metres along the optical axis, NaN where unknown.
        points_m: (N, 3) float32, camera frame, NaN where unknown; a keyframe's without depth may be
            known from other keyframes.
    """

    pixels: NDArray[np.float32]
    undistorted_px: NDArray[np.float32]
    octaves: NDArray[np.uint8]
    descriptors: NDArray[np.uint8]
    depth_m: NDArray[np.float32]
    points_m: NDArray[np.float32]

    @staticmethod
    def none() -> "Features":
        """Return those of a frame that has none."""
        pixels, numbers = np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
        descriptors, points_m = np.zeros((0, 32), np.uint8), np.zeros((0, 3), np.float32)
        return Features(pixels, pixels, np.zeros(0, np.uint8), descriptors, numbers, points_m)


@dataclass(frozen=True)
class Keyframe:
    """A frame kept in the map.

    Attributes:
        id: 0, 1, 2, ... in the order of time.
        timestamp_s: seconds.
        T_odom_cam: (4, 4) in the odometry's (drifting) frame, its segment's own until the end.
        features: ORB features.
        preview: the frame at `PREVIEW_SCALE`, for the report and the fused point cloud.
        turning_rad_s: how fast the camera turned; a rolling shutter bends such an image.
        segment: a number per stretch in which the camera was not lost and no session ended.
        camera: what took it where that is not the run's camera: those of a map name theirs.
    """

    id: int
    timestamp_s: float
    T_odom_cam: FloatArray
    features: Features
    preview: Frame
    turning_rad_s: float = 0.0
    segment: int = 0
    camera: Camera | None = None


class RejectionReason(StrEnum):
    """Why a pose could not be estimated or a loop not be accepted."""

    LOW_SIMILARITY = "similarity below the recognizer's threshold"
    SECOND_LOOK = "too little in common at a second look"
    SMEARED = "the image is smeared by motion"
    FEW_MATCHES = "too few descriptor matches with depth"
    NO_POSE = "no pose found by PnP RANSAC"
    FEW_INLIERS = "too few inliers of one rigid motion"
    LOW_INLIER_RATIO = "too small a share of the matches agree"
    NARROW_SUPPORT = "inliers cover too small a part of the image"
    UNCERTAIN_MOTION = "the motion is too uncertain to say anything: weak geometry"
    OUTVOTED = "contradicts the rest of the pose graph"
    UNJOINED = "its part of the map was not joined to the rest"


@dataclass(frozen=True)
class Rejection:
    """Why a stage said no: the number that decided, and what it had to be for a yes."""

    reason: RejectionReason
    measured: float
    needed: float


@dataclass(frozen=True)
class Check:
    """What a stage measured of a loop candidate, whatever it decided.

    Attributes:
        reason: what the candidate is rejected for where it does not pass.
        measured, needed: the number that decides, and what it has to be.
        passed: whether the stage said yes.
    """

    reason: RejectionReason
    measured: float
    needed: float
    passed: bool

    @staticmethod
    def at_least(reason: RejectionReason, measured: float, needed: float) -> "Check":
        """Return the check of a number that must not be smaller than what is needed."""
        return Check(reason, measured, needed, bool(measured >= needed))

    @property
    def rejection(self) -> Rejection | None:
        """Why the stage said no, None where it said yes."""
        return None if self.passed else Rejection(self.reason, self.measured, self.needed)


@dataclass(frozen=True)
class RelativePose:
    """A rigid motion between two views, as measured.

    Attributes:
        T_ref_query: (4, 4), takes the query camera's coordinates to the reference camera's.
        information: (6, 6), inverse covariance of the tangent [rotation; translation] applied on
            the right (`T_ref_query @ exp(xi)`), rad^-2 and m^-2: GTSAM's convention.
    """

    T_ref_query: FloatArray
    information: FloatArray


@dataclass(frozen=True)
class Verification:
    """What geometry says about two views: the outcome and the evidence behind it.

    Attributes:
        outcome: the motion, or why there is none.
        pixels: (M, 4) float32, matched pixels [u_ref, v_ref, u_query, v_query] in the images; like
            the points, (0, 4) of most loops in a large map.
        inlier_mask: (M,) bool, the matches that agree with the motion.
        points_ref_m: (M, 3) float32, what the matches show, metres, reference camera frame.
        checks: what was measured on the way, in order; of what came before an end, all.
    """

    outcome: RelativePose | Rejection
    pixels: NDArray[np.float32]
    inlier_mask: NDArray[np.bool_]
    points_ref_m: NDArray[np.float32]
    checks: tuple[Check, ...] = ()

    @property
    def without_evidence(self) -> "Verification":
        """The same without what the matches are, only how many; a sixtieth of the memory."""
        return replace(
            self, pixels=self.pixels[:0].copy(), points_ref_m=self.points_ref_m[:0].copy()
        )


@dataclass(frozen=True)
class Influence:
    """What one loop in use did to the map: the solved pose graph with it and without.

    Attributes:
        keyframe_ids: (K,) those of the graph.
        moved_m: (K, 3) float32, by how much each is elsewhere for this loop, world frame.
        chi_square: by how much the sum of squared errors, in units of the covariances, would fall
            without it; 6 on average where its noise is what it claims.
    """

    keyframe_ids: IntArray
    moved_m: NDArray[np.float32]
    chi_square: float

    @property
    def rms_m(self) -> float:
        """Root mean square of how far the keyframes were moved."""
        return float(np.sqrt((self.moved_m.astype(np.float64) ** 2).sum(axis=1).mean()))

    @property
    def most(self) -> tuple[int, float]:
        """The keyframe that was moved most, and how far, metres."""
        moved_m = np.linalg.norm(self.moved_m.astype(np.float64), axis=1)
        farthest = int(np.argmax(moved_m))
        return int(self.keyframe_ids[farthest]), float(moved_m[farthest])


class Proposal(StrEnum):
    """Why two keyframes were looked at as a loop."""

    SIMILARITY = "similarity"
    """They are among the most alike, as the run itself saw it."""
    NEXT_SIMILAR = "next_similar"
    """Of what the run left out they are the most alike."""
    OVERLAP = "overlap"
    """By the solved map their views overlap."""


MIN_TRUSTED_WEIGHT = 0.5
"""A motion that the pose graph gives no more weight than this is outvoted; most end at 0 or 1."""


@dataclass(frozen=True)
class LoopAttempt:
    """Every candidate that was looked at, accepted or not, and why.

    Attributes:
        query_id, match_id: keyframe ids; the query is the later one.
        similarity: of the two embeddings, -1 to 1; their cosine for most recognizers.
        verification: geometry's answer, or None where similarity already ruled the pair out.
        outcome: the motion of a loop in use (reference = match), or why it is not in use.
        weight: the pose graph's final trust in a loop that it was given, 0 (ignored) to 1; None
            before the graph was solved and for candidates that it was not given.
        min_similarity: from which candidates were verified when it was looked at, None where that
            is not on record.
        checks: what each stage measured of it, from the similarity to the pose graph.
        influence: what it did to the map; None of a loop not in use, or in a large map.
        proposed_by: what made it a candidate.
    """

    query_id: int
    match_id: int
    similarity: float
    verification: Verification | None
    outcome: RelativePose | Rejection
    weight: float | None = None
    min_similarity: float | None = None
    checks: tuple[Check, ...] = ()
    influence: Influence | None = None
    proposed_by: Proposal = Proposal.SIMILARITY

    @property
    def rejection(self) -> Rejection | None:
        """Why the loop is not in use; None where it is."""
        return self.outcome if isinstance(self.outcome, Rejection) else None

    @property
    def motion(self) -> RelativePose | None:
        """The motion that was measured, also of a loop that is not in use; None without one."""
        outcomes = (self.outcome, self.verification.outcome if self.verification else None)
        return next((each for each in outcomes if isinstance(each, RelativePose)), None)


@dataclass(frozen=True)
class Trajectory:
    """Camera poses over time.

    Attributes:
        timestamps_s: (N,) float64, strictly increasing.
        T_world_cam: (N, 4, 4) float64.
    """

    timestamps_s: FloatArray
    T_world_cam: FloatArray

    def __len__(self) -> int:
        return len(self.timestamps_s)

    def enlarged(self, factor: float) -> "Trajectory":
        """Return the same path through a world that is so many times larger."""
        T_world_cam = self.T_world_cam.copy()
        T_world_cam[:, :3, 3] *= factor
        return Trajectory(self.timestamps_s, T_world_cam)


@dataclass(frozen=True)
class Link:
    """A measured motion between two keyframes that is not a loop: odometry or co-visibility."""

    ref_id: int
    query_id: int
    motion: RelativePose
