# SPDX-License-Identifier: Apache-2.0
"""What a run found out."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from placerec.certificate import Certificate
from slam.types import Camera, FloatArray, Keyframe, Link, LoopAttempt, Trajectory

_MOSTLY_PASSING = 0.5
"""A threshold that so many pairs of different places pass sorts hardly anything out."""
_FEW_PAIRS = 50
"""Fewer pairs of either kind than this are no ground for a warning."""
_MOST_COMPARED = 400


def compared(count: int) -> range:
    """Return which of so many keyframes a result compares, all with each other.

    They are every n-th: as many as can be told apart in a picture, and enough for shares of pairs.
    Of more keyframes n is twice as large, so that those once left out stay so.
    """
    return range(0, count, 1 << max(0, -(-count // _MOST_COMPARED) - 1).bit_length())


@dataclass(frozen=True)
class Calibration:
    """What the recognizer was calibrated on, and how similar it found what it met.

    Attributes:
        certificate: the recognizer's own.
        live_similarities: (M,) float32, of all pairs of `compared` keyframes that could be loops.
        step: every so many-th keyframe is compared.
    """

    certificate: Certificate
    live_similarities: NDArray[np.float32]
    step: int = 1

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence where the two are too unlike for the threshold to be trusted, else none."""
        warning = self.certificate.outside_calibrated_range(self.live_similarities)
        return () if warning is None else (warning,)

    @property
    def passing(self) -> float:
        """Share of the live pairs that reach the calibrated `min_similarity`, NaN without pairs."""
        return self._share(self.live_similarities >= self.certificate.min_similarity)

    @property
    def outside(self) -> float:
        """Share of the live pairs outside the calibrated range, NaN without pairs."""
        low, high = self.certificate.calibrated_range
        return self._share((self.live_similarities < low) | (self.live_similarities > high))

    def _share(self, chosen: NDArray[np.bool_]) -> float:
        return float(chosen.mean()) if chosen.size else np.nan


@dataclass(frozen=True)
class ThresholdFit:
    """What a threshold does, by the pairs met so far.

    Attributes:
        min_similarity: the threshold, from which matches are verified.
        adapted: what it is, or would be, adapted to the pairs met.
        one_place_pairs: how many pairs were known to show one place.
        other_pairs: how many pairs nothing was known of, which nearly all show different places.
        cut: share of the pairs of one place that are below, as estimated; NaN where unknown.
        passing: share of the pairs of different places that are not, as estimated; NaN where
            unknown or where nearly all show one place.
    """

    min_similarity: float
    adapted: float
    one_place_pairs: int
    other_pairs: int
    cut: float
    passing: float

    @property
    def explanation(self) -> str:
        """How reliable the threshold is and where it should be, half a sentence."""
        seen = f"{self.one_place_pairs} pairs of one place and {self.other_pairs} others met"
        if np.isnan(self.cut):
            return f"{seen}, too few to tell how reliable this is"
        wrong = "an unknown share" if np.isnan(self.passing) else f"{self.passing:.0%}"
        return (
            f"{seen}: by estimate, {self.cut:.0%} of the pairs of one place are cut off and {wrong}"
            f" of those of different places pass; adapted to them it is {self.adapted:.3f}"
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence where the threshold sorts hardly anything out, else none."""
        few = min(self.one_place_pairs, self.other_pairs)
        if few < _FEW_PAIRS or not self.passing > _MOSTLY_PASSING:
            return ()
        advice = (
            f" (adapted to these images, it is {self.adapted:.3f}: --loop.min-similarity adapted)"
        )
        if self.min_similarity == self.adapted:
            advice = ""
        return (
            f"the recognizer hardly tells places apart here: by estimate, {self.passing:.0%} of the"
            f" pairs of different places reach the similarity {self.min_similarity:.3f} from which"
            f" matches are verified; geometry alone keeps false loops out{advice}",
        )


@dataclass(frozen=True)
class GivenOdometry:
    """What became of an odometry from elsewhere.

    Attributes:
        given: its poses as they came.
        corrected: the same poses, corrected: of the same body, in the same unit, at the same times,
            in a frame in which the first is as it came; without those that nothing is known of.
        T_map_odom: (N, 4, 4), what takes its poses to the corrected ones, metres.
        verdict: what the images say of it, a sentence.
        warnings: how it should have been read, and where the images contradict it; one each.
        steps: its motions between keyframes in the pose graph, with the trust they deserve.
        fits: whether it has to do with the images at all; if not, it was not used.
    """

    given: Trajectory
    corrected: Trajectory
    T_map_odom: FloatArray
    verdict: str
    warnings: tuple[str, ...]
    steps: tuple[Link, ...]
    fits: bool


@dataclass(frozen=True)
class MapMesh:
    """The map as a surface.

    Attributes:
        entropy: mean map entropy, nats; lower is sharper. NaN where too little was seen.
        off_plane_m: root of the mean plane variance: how far points lie off a plane through those
            around them, corners and curves included.
        overview: (H, W, 3) uint8, a picture of the whole.
        closer: (H, W, 3) uint8, of a part.
    """

    entropy: float
    off_plane_m: float
    overview: NDArray[np.uint8]
    closer: NDArray[np.uint8]


@dataclass(frozen=True)
class MapMeshes:
    """The map as a surface, of the same images along two paths.

    Attributes:
        before: along the odometry, None where no loop was closed.
        after: along the corrected path.
        closer_id: the keyframe that looked at what is seen closer: it shows most of the difference.
    """

    before: MapMesh | None
    after: MapMesh
    closer_id: int

    @property
    def explanation(self) -> str:
        """How sharp they are, half a sentence."""
        before, after = self.before, self.after
        if np.isnan(after.entropy):
            return "too few points lie together to tell how sharp it is"
        if before is None:
            return (
                f"map entropy {after.entropy:.3f}, points {1000.0 * after.off_plane_m:.1f} mm off"
                " the planes around them; no loop was closed, so there is one mesh only"
            )
        change = "sharper" if after.entropy < before.entropy else "not sharper"
        return (
            f"map entropy {before.entropy:.3f} before, {after.entropy:.3f} after: {change}; points"
            f" {1000.0 * before.off_plane_m:.1f} mm off the planes around them before,"
            f" {1000.0 * after.off_plane_m:.1f} mm after"
        )

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence where the map lost sharpness, else none."""
        if self.before is None or not self.after.entropy > self.before.entropy:
            return ()
        return (
            "the map is less sharp after loop closure than before: its entropy rose from"
            f" {self.before.entropy:.3f} to {self.after.entropy:.3f}; compare mesh_before.ply and"
            " mesh_after.ply",
        )


@dataclass(frozen=True)
class MoreLoops:
    """What there was before loops were looked for again, in a map that was solved by then.

    Attributes:
        before: the corrected trajectory, not smoothed.
        in_use: how many loops were in use.
        dropped: how many of those are not in use any more.
        rounds: how often they were looked for.
    """

    before: Trajectory
    in_use: int
    dropped: int
    rounds: int


@dataclass(frozen=True)
class SlamResult:
    """Everything a run found out.

    Attributes:
        camera: the camera it was run with.
        keyframes: the K keyframes in order of time, after those of an earlier map.
        T_world_kf: (K, 4, 4) corrected, the first one placed is the world; NaN where not joined.
            Not smoothed, whatever the trajectories are.
        odometry: every placed frame, as it was tracked (drifting); one motion joins two segments.
            Where poses came from elsewhere, those of the camera, as they came.
        live: the same, each corrected by the loops that were closed until then; without the frames
            of a segment of which was not known yet where it lies.
        without_loops: the same in the end, with all that is done to the map but loop closure.
        trajectory: the same in the end, corrected; `T_world_kf` at the keyframes' times unless
            `motion.smooth` asks for smoothing and the camera was tracked here.
        links: odometry and co-visibility motions of the pose graph.
        attempts: every loop candidate in the order it was looked at, with its final weight.
        similarities: (N, N) float32, -1 to 1, between the embeddings of the `compared` keyframes:
            all of up to 400, else every n-th.
        min_similarity: the threshold from which candidates were verified, the last one where it was
            adapted.
        untracked_s: timestamps of the frames that are in no trajectory: lost, not joined, or later
            than a failure of the recognizer.
        stage_seconds: total wall time per stage, in the order of the pipeline; some overlap.
        warnings: what a user should know before trusting the result; one sentence each.
        calibration: where the recognizer's threshold comes from, None where nobody says so.
        threshold: how reliable the threshold is by what was met, None where nobody can tell.
        unjoined_s: those of the untracked frames that are in a part that was not joined.
        session_starts_s: timestamp of the first frame of each session after the first.
        elapsed_s: wall time of the whole run, waiting for frames included; None where unknown.
        compiling_s: for how long of that loops were compiled, which later runs find compiled.
        unsmoothed: `trajectory` before it was smoothed, None where it was not. The other
            trajectories and `T_world_kf` never are.
        given: what became of an odometry from elsewhere, None where there is none.
        missing: which parts of the result could not be computed, and why; one sentence each. What
            stands for them says nothing: NaN similarities, poses that were not adjusted.
        meshes: the map as surfaces, None where they were not asked for or could not be made.
        more_loops: what there was before loops were looked for again, None where they were not.
        earlier: how many of the keyframes are of an earlier map, whose frames are not in this.
    """

    camera: Camera
    keyframes: tuple[Keyframe, ...]
    T_world_kf: FloatArray
    odometry: Trajectory
    live: Trajectory
    without_loops: Trajectory
    trajectory: Trajectory
    links: tuple[Link, ...]
    attempts: tuple[LoopAttempt, ...]
    similarities: NDArray[np.float32]
    min_similarity: float
    untracked_s: FloatArray
    stage_seconds: dict[str, float]
    warnings: tuple[str, ...]
    calibration: Calibration | None = None
    unjoined_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    session_starts_s: FloatArray = field(default_factory=lambda: np.zeros(0))
    elapsed_s: float | None = None
    compiling_s: float | None = None
    unsmoothed: Trajectory | None = None
    given: GivenOdometry | None = None
    missing: tuple[str, ...] = ()
    threshold: ThresholdFit | None = None
    meshes: MapMeshes | None = None
    more_loops: MoreLoops | None = None
    earlier: int = 0

    @property
    def corrected(self) -> Trajectory:
        """The corrected trajectory, never smoothed."""
        return self.trajectory if self.unsmoothed is None else self.unsmoothed

    @property
    def has_images(self) -> bool:
        """Whether any keyframe has its image; those made anew from a journal have none."""
        return any(keyframe.preview.depth_m.any() for keyframe in self.keyframes)

    @property
    def moved_by_loops_m(self) -> FloatArray:
        """(N,) how far loops moved each frame of the corrected trajectory."""
        shift = self.corrected.T_world_cam - self.without_loops.T_world_cam
        return np.asarray(np.linalg.norm(shift[:, :3, 3], axis=1))
