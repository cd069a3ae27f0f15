# SPDX-License-Identifier: Apache-2.0
"""Signs of wrong settings: a camera, or depth, that is hardly possible."""

import math
from collections.abc import Sequence as Items

import numpy as np
from numpy.typing import NDArray

from slam.types import Camera

_FIELD_OF_VIEW_DEG = (20.0, 140.0)
_ASPECT = (0.8, 1.25)
_MAX_CENTRE_OFFSET = 0.25
_MEDIAN_DEPTH_M = (0.4, 4.5)  # what structured-light cameras indoors see; scales differ by 5
_MAX_MISSING = 0.9
_USUAL_SCALES = (5000.0, 1000.0, 1.0)
_USUAL_DEPTH_M = 2.0


def doubts_about_intrinsics(camera: Camera) -> list[str]:
    """Return one sentence for each property of the pinhole model that is hardly possible."""
    doubts = []
    field_deg = math.degrees(2.0 * math.atan(camera.width / (2.0 * camera.fx)))
    if not _FIELD_OF_VIEW_DEG[0] <= field_deg <= _FIELD_OF_VIEW_DEG[1]:
        doubts.append(
            f"the camera's fx = {camera.fx:g} px at a width of {camera.width} px means a horizontal"
            f" field of view of {field_deg:.0f} degrees; {_FIELD_OF_VIEW_DEG[0]:.0f} to"
            f" {_FIELD_OF_VIEW_DEG[1]:.0f} is usual"
        )
    if not _ASPECT[0] <= camera.fx / camera.fy <= _ASPECT[1]:
        doubts.append(
            f"the camera's fx = {camera.fx:g} and fy = {camera.fy:g} px differ by more than a"
            " quarter; they are nearly equal on usual cameras"
        )
    right, down = camera.cx / camera.width - 0.5, camera.cy / camera.height - 0.5
    if max(abs(right), abs(down)) > _MAX_CENTRE_OFFSET:
        doubts.append(
            f"the camera's principal point ({camera.cx:g}, {camera.cy:g}) is farther than"
            f" {_MAX_CENTRE_OFFSET:.0%} from the centre of its {camera.width}x{camera.height} image"
        )
    return doubts


def doubts_about_depth(depths_m: Items[NDArray[np.float32]], depth_scale: float) -> list[str]:
    """Return one sentence for each thing that a few depth images (H, W), metres, speak against."""
    pixels = np.concatenate([depth_m.ravel() for depth_m in depths_m]) if depths_m else np.empty(0)
    if not len(pixels):
        return []
    known_m = pixels[pixels > 0.0]
    missing = 1.0 - len(known_m) / len(pixels)
    doubts = []
    if missing > _MAX_MISSING:
        doubts.append(
            f"{missing:.0%} of the depth pixels of {len(depths_m)} sampled images are missing (0)"
        )
    if not len(known_m):
        return doubts
    median_m = float(np.median(known_m))
    if not _MEDIAN_DEPTH_M[0] <= median_m <= _MEDIAN_DEPTH_M[1]:
        doubts.append(
            f"the median depth of {len(depths_m)} sampled images is {median_m:.3g} m with"
            f" {depth_scale:g} units per metre; {_advice(median_m * depth_scale)}"
        )
    return doubts


def _advice(median_units: float) -> str:
    """Return which scale would make it the depth of a room, if one does; not the one in use."""
    nearest_m, farthest_m = _MEDIAN_DEPTH_M
    scales = [each for each in _USUAL_SCALES if nearest_m <= median_units / each <= farthest_m]
    if not scales:
        return (
            "no usual depth scale makes that the depth of a room; does it show one, or are the"
            " images inverted, in another order of bytes, or something else than depth?"
        )
    scale = min(scales, key=lambda each: abs(math.log(median_units / each / _USUAL_DEPTH_M)))
    return f"--input.depth-scale {scale:g} would make it {median_units / scale:.3g} m"
