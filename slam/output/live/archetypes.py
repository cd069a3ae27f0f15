# SPDX-License-Identifier: Apache-2.0
"""Rerun's archetypes as this project uses them, and how its viewer is laid out."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from slam.types import Camera, FloatArray, LoopAttempt

PLOTS = ("shift_mm", "covered_percent", "tracking_ms")
_JPEG_QUALITY = 75


def lines(
    attempts: Sequence[LoopAttempt],
    T_world_kf: Mapping[int, FloatArray],
    colour: tuple[int, int, int],
) -> Any:
    """Return lines between the keyframes of loop candidates, as far as these have a place."""
    pairs = [(each.match_id, each.query_id) for each in attempts]
    placed = [pair for pair in pairs if all(k in T_world_kf for k in pair)]
    strips = [[T_world_kf[k][:3, 3].astype(np.float32) for k in pair] for pair in placed]
    return rr.LineStrips3D(strips, colors=[colour])


def jpeg(rgb: NDArray[np.uint8]) -> Any:
    """Return a (H, W, 3) image, compressed."""
    return rr.Image(rgb).compress(jpeg_quality=_JPEG_QUALITY)


def transform(T_world_cam: FloatArray) -> Any:
    """Return a (4, 4) pose, metres."""
    return rr.Transform3D(translation=T_world_cam[:3, 3], mat3x3=T_world_cam[:3, :3])


def pinhole(camera: Camera, scale: float) -> Any:
    """Return the camera for images of another scale, whose pixels are numbered by their middles."""
    matrix = camera.matrix
    matrix[:2] *= scale
    size = (int(camera.width * scale), int(camera.height * scale))
    return rr.Pinhole(image_from_camera=matrix, resolution=size, camera_xyz=rr.ViewCoordinates.RDF)


def blueprint() -> Any:
    """Return where the viewer shows what: space at the left; camera, matches, plots, log beside."""
    beside = rrb.Vertical(
        rrb.Spatial2DView(origin="world/camera/colour", name="camera"),
        rrb.Spatial2DView(origin="matches", name="the last loop"),
        rrb.Tabs(*(rrb.TimeSeriesView(origin=f"plots/{each}") for each in PLOTS), active_tab=0),
        rrb.TextLogView(origin="log", name="loops"),
    )
    space = rrb.Spatial3DView(origin="world", name="path and map")
    return rrb.Blueprint(rrb.Horizontal(space, beside, column_shares=[2, 1]), collapse_panels=True)
