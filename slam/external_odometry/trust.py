# SPDX-License-Identifier: Apache-2.0
"""How far an odometry from elsewhere is to be trusted: as far as the images bear it out.

Every motion that images measured between two keyframes, link or loop, is compared with what the
odometry says of the same two. What is left beyond the noise that the images claim is its own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from slam.external_odometry.comparison import Comparison, GivenKeyframe, GivenPath
from slam.geometry import se3
from slam.types import FloatArray, IntArray, Link, RelativePose

_RIGHT_MEDIAN = 5.35  # of a squared error in units of its covariance, six degrees of freedom
_MIN_COMPARED = 8  # motions; of fewer nothing can be said, and nothing of fewer in a span
# Truth itself has been seen at up to this many times the right median, and the median over N images
# is known to this much over the root of N: three standard deviations, for it is asked again and
# again on the way, and each false alarm moves the camera.
_IN_DOUBT, _MEDIAN_SPREAD = 1.2, 2.5
# Truth has not been seen below half the right median; what was made from the same images, below a
# seventh. Its errors are ours, and it adds nothing to them.
_SHARED = 0.3
# Squared errors, where the usual ones are right, of a step alone and of most motions over up to so
# many steps, at least so many of them. The first image is straightened without knowing how the
# camera moved: it contradicts truth at 68 on fr1_desk.
_JUMP, _BAD_STRETCH, _STRETCH, _MIN_OVER = 60.0, 25.0, 16, 5
_FIRST_JUMP = 600.0
_STIFF = 1e-3  # of the images' noise: what they cannot tell from the truth they do not bend
_FIT_ROUNDS = 6
_NEGLIGIBLE = 0.01  # of the variance that the images claim
_LEAST = 1e-12  # variance, rad^2 and m^2
# Where nothing was compared: a fair wheel or visual odometry.
_ASSUMED_ROTATION = (np.radians(1.0) ** 2, np.radians(1.0) ** 2, np.radians(0.2) ** 2)
_ASSUMED_TRANSLATION = (0.02**2, 0.02**2, 0.005**2)


class Verdict(StrEnum):
    """What the images say of an odometry."""

    UNKNOWN = "too few motions could be compared with the images"
    BORNE_OUT = "the images cannot tell it from the truth"
    SHARED = "it agrees with the images more closely than they can know, so it was made from them"
    CONTRADICTED = "over short ways the images bear it out, but loops contradict it"
    NOISY = "the images contradict it by more than their own noise"


@dataclass(frozen=True)
class Trust:
    """What the images say of an odometry.

    Attributes:
        verdict: in words.
        rotation_noise, translation_noise: (3,) variance, rad^2 and m^2 per axis, that its motions
            gain per metre, per radian and per second.
        doubted: the keyframe ids that a step leads to which the images contradict far more than the
            others; such steps are not used.
        steps: its motions from one keyframe to the next, with the information they deserve.
        compared: how many motions of the images it was compared with.
    """

    verdict: Verdict
    rotation_noise: FloatArray
    translation_noise: FloatArray
    doubted: tuple[int, ...]
    steps: tuple[Link, ...]
    compared: int

    @property
    def is_followed(self) -> bool:
        """Whether to follow it, not the images, from one keyframe to the next."""
        return self.verdict in (Verdict.BORNE_OUT, Verdict.UNKNOWN)


def judge(
    motions: Sequence[Link], given: Mapping[int, GivenKeyframe], stamps_s: Mapping[int, float]
) -> Trust:
    """Return how far an odometry is to be trusted that has keyframes, by id.

    The motions are what images measured between keyframes, which have times by id.
    """
    path = GivenPath(given, stamps_s)
    motions = [each for each in motions if path.has(each)]
    steps, compared = path.steps(), len(motions)
    doubted: tuple[int, ...] = ()
    for find in (_jumps, _bad_stretches):
        doubted = tuple(sorted({*doubted, *find(motions, path)}))
        path = GivenPath(given, stamps_s, doubted)
        motions = [each for each in motions if path.has(each)]
    # What the first image shows is bent in a way that its noise does not tell.
    verdict, rotation, translation = _weigh(path.but_of_first(motions) or motions, path)
    links: list[Link] = []
    if verdict is not Verdict.SHARED:
        # What the images contradict is nowhere known better than they know themselves; what they do
        # not, they do not bend.
        images = _images_variance(motions) if motions else np.zeros(6)
        share = _STIFF**2 if verdict is Verdict.BORNE_OUT else 1.0
        for a, b in steps:
            if b in doubted:
                continue
            (extent,) = path.extents(np.array([[a, b]]))
            own = np.repeat([rotation @ extent, translation @ extent], 3)
            told = given[b].covariance
            noise = np.diag(share * images + own + _LEAST) if told is None else told
            T_a_b = se3.inverse(given[a].T_given_cam) @ given[b].T_given_cam
            motion = RelativePose(T_a_b, np.asarray(np.linalg.inv(noise)))
            links.append(Link(a, b, motion))
    return Trust(verdict, rotation, translation, doubted, tuple(links), compared)


_NOTHING = np.zeros(3)


def _jumps(motions: Sequence[Link], path: GivenPath) -> tuple[int, ...]:
    """Return the keyframe ids that a step leads to which the images contradict."""
    squared, ends = _in_usual_units(motions, path)
    limit = np.where(ends[:, 0] == 0, _FIRST_JUMP, _JUMP)
    is_jump = (ends[:, 1] - ends[:, 0] == 1) & (squared > limit)
    return tuple(path.ids[ends[is_jump, 1]].tolist())


def _bad_stretches(motions: Sequence[Link], path: GivenPath) -> tuple[int, ...]:
    """Return those that a step leads to over which most of what the images say contradicts it."""
    squared, ends = _in_usual_units(motions, path)
    lags = ends[:, 1] - ends[:, 0]
    short = np.flatnonzero((lags > 1) & (lags <= _STRETCH))
    short = short[np.argsort(ends[short, 0], kind="stable")]
    squared, ends = squared[short], ends[short]
    rows = np.arange(len(path.ids))
    begin, end = (np.searchsorted(ends[:, 0], each) for each in (rows - _STRETCH, rows))
    doubted = []
    for row in range(1, len(path.ids)):
        near = slice(begin[row], end[row])  # those that start before it, and not long before
        is_over = row <= ends[near, 1]
        over = squared[near][is_over]
        # Motions of one image are wrong together: it takes more than one at either end.
        is_of_one = any(len(np.unique(each)) < 2 for each in ends[near][is_over].T)
        if len(over) < _MIN_OVER or is_of_one:
            continue
        if np.sort(over)[(len(over) - 1) // 2] > _BAD_STRETCH:
            doubted.append(int(path.ids[row]))
    return tuple(doubted)


def _in_usual_units(motions: Sequence[Link], path: GivenPath) -> tuple[FloatArray, IntArray]:
    """Return (N,) squared errors, of which the median is not too large, and (N, 2) rows, in order.

    There are none where too few could be compared.
    """
    if len(motions) < _MIN_COMPARED:
        return np.zeros(0), np.zeros((0, 2), np.int64)
    squared = Comparison.of(motions, path).squared(_NOTHING, _NOTHING)
    ends = np.sort(path.rows(np.array([(each.ref_id, each.query_id) for each in motions])), axis=1)
    return squared / max(1.0, float(np.median(squared)) / _RIGHT_MEDIAN), ends


def _weigh(motions: Sequence[Link], path: GivenPath) -> tuple[Verdict, FloatArray, FloatArray]:
    """Return the verdict, and the variances of rotation and translation, (3,) each."""
    assumed = np.array(_ASSUMED_ROTATION), np.array(_ASSUMED_TRANSLATION)
    if not motions:
        return Verdict.UNKNOWN, *assumed
    compared = Comparison.of(motions, path)
    squared = compared.squared(_NOTHING, _NOTHING)
    if len(motions) < _MIN_COMPARED:  # most of them begin at the first image
        is_far_off = float(np.median(squared)) > _FIRST_JUMP
        return Verdict.NOISY if is_far_off else Verdict.UNKNOWN, *assumed
    if np.median(squared) < _SHARED * _RIGHT_MEDIAN:
        return Verdict.SHARED, _NOTHING, _NOTHING
    spans = _spans(compared.lags)
    if all(_is_usual(squared[span], compared.images[span]) for span in spans):
        return Verdict.BORNE_OUT, _NOTHING, _NOTHING
    rotation, translation = (_variances(compared, part) for part in (slice(0, 3), slice(3, 6)))
    if _is_negligible(compared, rotation, translation):
        # Then the images are noisier than they claim: what an odometry is off grows on the way.
        return Verdict.BORNE_OUT, _NOTHING, _NOTHING
    squared = compared.squared(rotation, translation)
    # What grows faster than a random walk is taken for as large as it gets on any span.
    worst = max(float(np.median(squared[span])) for span in spans) / _RIGHT_MEDIAN
    return Verdict.NOISY, max(worst, 1.0) * rotation, max(worst, 1.0) * translation


def _is_negligible(compared: Comparison, rotation: FloatArray, translation: FloatArray) -> bool:
    """Whether noise is small beside the images', even over the longest way that was compared."""
    own = np.repeat(compared.extents.max(axis=0) @ np.column_stack([rotation, translation]), 3)
    images = np.median(np.einsum("nii->ni", compared.covariances), axis=0)
    return bool((own < _NEGLIGIBLE * images).all())


def _spans(lags: IntArray) -> list[NDArray[np.bool_]]:
    """Return masks of motions that span about as many keyframes, each of enough of them."""
    octave = np.log2(np.maximum(lags, 1)).astype(int)
    masks = [octave == each for each in range(int(octave.max()) + 1)]
    enough = [mask for mask in masks if mask.sum() >= _MIN_COMPARED]
    return enough or [np.ones(len(lags), bool)]


def _is_usual(squared: FloatArray, images: IntArray) -> bool:
    # Motions of one image are wrong together: no more is known than there are images.
    limit = _IN_DOUBT + _MEDIAN_SPREAD / np.sqrt(len(np.unique(images)))
    return bool(np.median(squared) <= limit * _RIGHT_MEDIAN)


def _variances(compared: Comparison, part: slice) -> FloatArray:
    """Return (3,) variances per metre, radian and second that the errors have beyond the images'.

    Iterated least squares, each motion by what its own variance lets be known, outliers by less.
    """
    from scipy.optimize import nnls  # loaded where there is an odometry from elsewhere alone

    squared = (compared.errors[:, part] ** 2).mean(axis=1)
    images = np.einsum("nii->n", compared.covariances[:, part, part]) / 3.0
    variances = _NOTHING
    for _ in range(_FIT_ROUNDS):
        expected = images + compared.extents @ variances
        outlying = squared / expected
        weight = 1.0 / (expected * np.sqrt(1.0 + outlying))
        variances = nnls(compared.extents * weight[:, None], (squared - images) * weight)[0]
    return np.asarray(variances)


def _images_variance(motions: Sequence[Link]) -> FloatArray:
    """Return the (6,) variances that a motion of the images typically claims."""
    noise = [np.diag(np.linalg.inv(each.motion.information)) for each in motions]
    return np.asarray(np.median(noise, axis=0))
