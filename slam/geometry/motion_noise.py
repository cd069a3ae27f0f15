# SPDX-License-Identifier: Apache-2.0
"""How far off a measured motion may be for reasons that its matches do not show.

Matches tell how well they determine a motion; they are all bent alike by what the camera's model
leaves out. Both constants of the rolling shutter were measured on fr1_desk and fr1_xyz, that of the
lens on the demo: with them the squared errors of links and loops, in units of their covariance
(NEES), have about the median that they should have. `benchmarks/sequences.py` shows it.
"""

from dataclasses import replace

import numpy as np

from slam.types import Camera, Features, RelativePose

_LENS_PX = 0.1  # what a calibration leaves of the lens
# Rows of a rolling shutter are put where the camera's motion says. How fast it turned while they
# were read is known to so many rad/s, and to this share of the turning.
_TURNING_RAD_S, _TURNING_SHARE = 0.2, 0.5
# Keyframes that share landmarks are bent by the same things, less than two views of a loop.
_LINK_SHARE = 0.75
# Several keyframes make a landmark, and pixels are not as noisy as robust matching takes them for.
_LINK_INFORMATION = 4.0


def loop_noise(
    motion: RelativePose, camera: Camera, depth_m: float, *turning_rad_s: float
) -> RelativePose:
    """Return a motion that two views measured, with the noise of the camera added to its own.

    A bent image shifts the camera the more the further away what it shows is, typically `depth_m`,
    and is bent the more the faster each of the two views turned.
    """
    bend_rad = float(np.hypot(_LENS_PX / camera.fx, _shutter_rad(camera, turning_rad_s)))
    return _with_noise(motion, bend_rad, depth_m)


def link_noise(
    motion: RelativePose, camera: Camera, depth_m: float, *turning_rad_s: float
) -> RelativePose:
    """Return the same of a motion between two keyframes of the map, which shared landmarks hold."""
    sharper = replace(motion, information=_LINK_INFORMATION * motion.information)
    return _with_noise(sharper, _LINK_SHARE * _shutter_rad(camera, turning_rad_s), depth_m)


def _shutter_rad(camera: Camera, turning_rad_s: tuple[float, ...]) -> float:
    turning = _TURNING_SHARE * float(np.linalg.norm(turning_rad_s))
    return float(camera.readout_s * np.hypot(_TURNING_RAD_S, turning))


def _with_noise(motion: RelativePose, rotation_rad: float, depth_m: float) -> RelativePose:
    noise = rotation_rad**2 * np.diag([1.0, 1.0, 1.0, *[depth_m**2] * 3])
    total = np.linalg.inv(np.linalg.inv(motion.information) + noise)
    return replace(motion, information=np.asarray(0.5 * (total + total.T)))


def typical_depth_m(*views: Features) -> float:
    """Return the median depth of what views show, metres; 1 where none of them has depth."""
    depth_m = np.concatenate([each.depth_m for each in views])
    known = depth_m[np.isfinite(depth_m)]
    return float(np.median(known)) if len(known) else 1.0


def translation_sigma_m(motion: RelativePose) -> float:
    """Return the standard deviation of a motion's translation, metres, all directions together."""
    return float(np.sqrt(np.trace(np.linalg.inv(motion.information)[3:, 3:])))
