# SPDX-License-Identifier: Apache-2.0
"""What to tell the user of an odometry from elsewhere: a sentence each, with the number to use."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slam.config import OdometryConfig
from slam.external_odometry.calibration import Calibration
from slam.external_odometry.conventions import Convention
from slam.external_odometry.hand_eye import seven_numbers
from slam.external_odometry.trust import Trust, Verdict
from slam.geometry import se3

# What is smaller is not worth a word, and less than so many standard deviations may be chance.
_OFFSET_S, _SCALE = 0.02, 0.01
_SIGMAS = 4.0
# Of the motions left under the best reading: more, and frame, clock and unit cannot be told; more
# still, and the poses have nothing to do with the images. Those of other recordings leave 1.
_VAGUE, _NO_FIT = 0.3, 0.95
# Correlation of turning: what is only noisy is more alike than the first; below the second some of
# the poses do not belong, and nothing is said of how to read the others.
_ALIKE, _ONE_BODY = 0.6, 0.9
_MIXED = 0.25  # share of the motions that are not explained at all, where the others are
_NOT_OF_THESE_IMAGES = (
    "the odometry's poses do not fit the images in whatever way they are read: they are of another"
    " recording, or of several frames mixed; they were not used"
)
_SIDE_ALONE = 0.15  # misfit of either part of a run where no one frame does for both: two bodies
_DRIFT, _DRIFT_SIGMAS = 0.03, 3.0  # of the scale, from the first quarter of a run to the last
_BETTER = 0.9  # what is left under another reading than the one asked for, as a share


@dataclass(frozen=True)
class Reading:
    """How given poses are read in the end, and what there is to say of it.

    Attributes:
        convention: the one to use.
        sentences: one each.
        fits: whether the poses have to do with the images at all.
    """

    convention: Convention
    sentences: tuple[str, ...] = ()
    fits: bool = True


def asked_convention(config: OdometryConfig) -> Convention:
    """Return how the settings say that given poses are to be read, what is `auto` left as it is."""
    T_base_cam = np.eye(4)
    if isinstance(config.T_base_cam, tuple):
        tx, ty, tz, *quaternion = config.T_base_cam
        R = se3.from_quaternion(np.array(quaternion))
        T_base_cam = se3.from_rotation_translation(R, np.array([tx, ty, tz]))
    return Convention(
        T_base_cam,
        1.0 if config.scale == "auto" else config.scale,
        0.0 if config.time_offset_s == "auto" else config.time_offset_s,
        config.inverted,
        config.w_first,
    )


def read(config: OdometryConfig, found: Calibration | None) -> Reading:
    """Return how to read the poses, by the settings and by what the images say of them."""
    asked = asked_convention(config)
    if found is None:
        return Reading(asked)
    if misfit := _mixed(found) or _foreign(found):
        return Reading(asked, (misfit,), fits=False)
    is_vague = found.misfit > _VAGUE or found.hand_eye.likeness < _ONE_BODY
    if is_vague:
        return Reading(asked)
    drift = _scale_drift(found)
    if found.misfit > _BETTER * found.misfit_before:
        return Reading(asked, drift)
    used, best = asked, found.convention
    direction, frame, clock, scale = (
        part(config, found, asked) for part in (_direction, _frame, _clock, _scale)
    )
    if config.T_base_cam == "auto":
        used = replace(used, is_inverted=best.is_inverted, is_w_first=best.is_w_first)
        if frame:
            used = replace(used, T_base_cam=best.T_base_cam)
    if config.time_offset_s == "auto" and clock:
        used = replace(used, time_offset_s=best.time_offset_s)
    if config.scale == "auto" and scale:
        used = replace(used, scale=best.scale)
    return Reading(used, (*direction, *frame, *clock, *scale, *drift))


def _foreign(found: Calibration) -> str | None:
    best, left = found.hand_eye, min(found.misfit, found.misfit_before)
    is_other = left > _NO_FIT and best.likeness < _ALIKE
    is_in_part = left < _VAGUE and best.unexplained > _MIXED
    return _NOT_OF_THESE_IMAGES if is_other or is_in_part else None


def _mixed(found: Calibration) -> str | None:
    """Return a sentence if an early and a late part are poses of different bodies."""
    if not found.sides or found.misfit_of_sides < _VAGUE:
        return None
    early, late = found.sides
    if max(early.misfit, late.misfit) > _SIDE_ALONE:
        return None
    off = se3.inverse(early.T_base_cam) @ late.T_base_cam
    turned_deg, moved_m = np.degrees(se3.rotation_angle(off)), float(se3.translation_norm(off))
    return (
        "the odometry's earlier and later poses are of two frames mixed, turned by"
        f" {turned_deg:.0f} deg and {100.0 * moved_m:.0f} cm apart: hand over those of one; they"
        " were not used"
    )


def _scale_drift(found: Calibration) -> tuple[str, ...]:
    if not found.ends or min(each.scale for each in found.ends) <= 0.0:
        return ()
    first, last = found.ends
    ratio = last.scale / first.scale
    sigma = float(np.hypot(first.scale_sigma / first.scale, last.scale_sigma / last.scale))
    if abs(ratio - 1.0) < max(_DRIFT, _DRIFT_SIGMAS * sigma):
        return ()
    return (
        f"the odometry's scale drifts: its ways would have to be multiplied by {first.scale:.3f} in"
        f" the first quarter of the run and by {last.scale:.3f} in the last (known to {sigma:.1%});"
        " no one --odometry.scale mends that",
    )


def _direction(config: OdometryConfig, found: Calibration, asked: Convention) -> list[str]:
    best, sentences = found.convention, []
    is_auto = config.T_base_cam == "auto"
    done = "; it was applied" if is_auto else ", or --odometry.T-base-cam auto"
    if best.is_inverted != asked.is_inverted:
        what = "world to the camera" if best.is_inverted else "camera to the world"
        flag = f"--odometry.inverted {best.is_inverted}"
        sentences.append(f"the odometry's poses take the {what}: {flag}{done}")
    if best.is_w_first != asked.is_w_first:
        what = "w x y z" if best.is_w_first else "x y z w"
        flag = f"--odometry.w-first {best.is_w_first}"
        sentences.append(f"the odometry's quaternions are {what}: {flag}{done}")
    return sentences


def _frame(config: OdometryConfig, found: Calibration, asked: Convention) -> list[str]:
    T, known = found.convention.T_base_cam, found.hand_eye
    off = se3.inverse(asked.T_base_cam) @ T
    sigma_deg = np.degrees(known.rotation_sigma_rad)
    if not known.tells_apart(off):
        return []
    done = "it was applied" if config.T_base_cam == "auto" else "or auto"
    other = "the camera's optical one" if config.T_base_cam in (None, "auto") else "asked for"
    return [
        f"the odometry's poses are of another frame than {other}: --odometry.T-base-cam"
        f" {seven_numbers(T)}"
        f" (known to {sigma_deg:.1f} deg and {100.0 * known.arm_sigma_m:.1f} cm); {done}"
    ]


def _clock(config: OdometryConfig, found: Calibration, asked: Convention) -> list[str]:
    offset_s = found.convention.time_offset_s
    more_s = offset_s - asked.time_offset_s
    if abs(more_s) <= _OFFSET_S:
        return []
    late = "later" if more_s > 0.0 else "earlier"
    than = "asked for" if asked.time_offset_s else "the images'"
    done = "it was applied" if config.time_offset_s == "auto" else "or auto"
    return [
        f"the odometry's time stamps are {abs(more_s) * 1e3:.0f} ms {late} than {than}:"
        f" --odometry.time-offset-s {offset_s:.3f}; {done}"
    ]


def _scale(config: OdometryConfig, found: Calibration, asked: Convention) -> list[str]:
    scale, sigma = found.convention.scale, found.hand_eye.scale_sigma
    ratio = scale / asked.scale
    if abs(ratio - 1.0) <= max(_SCALE, _SIGMAS * sigma / scale):
        return []
    what = "short" if ratio > 1.0 else "long"
    unit = " (feet)" if asked.scale == 1.0 and abs(scale / 0.3048 - 1.0) < 0.05 else ""
    done = "it was applied" if config.scale == "auto" else "or auto"
    return [
        f"the odometry's ways are {abs(1.0 / ratio - 1.0):.1%} too {what}{unit}: --odometry.scale"
        f" {scale:.4f} (known to {sigma / scale:.1%}); {done}"
    ]


def judgement(trust: Trust, stamps_s: Mapping[int, float]) -> tuple[str, tuple[str, ...]]:
    """Return what the images say of the odometry, and sentences on where they contradict it."""
    noise = f"; its noise is {_noise(trust)}" if trust.verdict is Verdict.NOISY else ""
    count = f"compared with {trust.compared} motions of the images"
    verdict = f"the odometry, {count}: {trust.verdict}{noise}"
    runs = _runs(trust.doubted)
    if not runs:
        return verdict, ()
    spans = [f"{stamps_s[first]:.2f} to {stamps_s[last]:.2f} s" for first, last in runs[:3]]
    more = f" and {len(runs) - 3} more stretches" if len(runs) > 3 else ""
    doubt = f"the images contradict the odometry from {', '.join(spans)}{more}"
    return verdict, (f"{doubt}; they bridge it there",)


def _noise(trust: Trust) -> str:
    units = ("metre", "radian", "second")
    rotation_deg = np.degrees(np.sqrt(trust.rotation_noise))
    translation_cm = 100.0 * np.sqrt(trust.translation_noise)
    parts = [
        f"{deg:.2g} deg and {cm:.2g} cm in a {unit}"
        for deg, cm, unit in zip(rotation_deg, translation_cm, units, strict=True)
        if deg > 0.0 or cm > 0.0
    ]
    return ", ".join(parts) or "less than can be told apart from the images'"


def _runs(doubted: Sequence[int]) -> list[tuple[int, int]]:
    """Return the first and last keyframe id of stretches of consecutive doubted steps."""
    runs: list[tuple[int, int]] = []
    for k in doubted:
        if runs and k == runs[-1][1] + 1:
            runs[-1] = (runs[-1][0], k)
        else:
            runs.append((k - 1, k))
    return runs
