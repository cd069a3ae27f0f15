# SPDX-License-Identifier: Apache-2.0
"""What keyframes show, small: a picture of each for the page, and points for its map."""

import base64
from collections.abc import Iterable
from io import BytesIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from slam.geometry.features import back_project, undistort
from slam.output.decision import Decision
from slam.result import SlamResult
from slam.types import PREVIEW_SCALE, FloatArray

_PICTURES_BYTES = 2_000_000
_WIDEST_PX, _NARROWEST_PX = 320, 160
_QUALITY = 60
_BYTES_PER_PIXEL = 0.2  # about what such a JPEG takes, in base64

_MOST_POINTS = 18_000  # before those without depth are left out; more make turning slow
_MOST_KEYFRAMES = 200
_FARTHEST = 2.5  # of the median depth, as in map.ply
_STEPS = 32_000  # of whole numbers of 16 bits, to the farthest point


def pictures(result: SlamResult, loops: Iterable[Decision]) -> dict[int, str]:
    """Return JPEG data URIs of keyframes by their ids, of the first loops as many as have room."""
    ids = list(dict.fromkeys(each.id for loop in loops for each in (loop.match, loop.query)))
    if not result.has_images or not ids:
        return {}
    height, width = result.keyframes[0].preview.depth_m.shape
    room = (_PICTURES_BYTES / (len(ids) * _BYTES_PER_PIXEL * height / width)) ** 0.5
    size = min(width, _WIDEST_PX, max(_NARROWEST_PX, int(room)))
    found: dict[int, str] = {}
    left = _PICTURES_BYTES
    keyframes = {keyframe.id: keyframe for keyframe in result.keyframes}
    for number in ids:
        picture = picture_of(keyframes[number].preview.rgb, size)
        left -= len(picture)
        if left < 0:
            break
        found[number] = picture
    return found


def picture_of(rgb: NDArray[np.uint8], width: int, quality: int = _QUALITY) -> str:
    """Return an image, not wider than this, as the data URI of a JPEG."""
    view = Image.fromarray(rgb)
    if view.width > width:
        height = round(width * view.height / view.width)
        view = view.resize((width, height), Image.Resampling.BILINEAR)
    jpeg = BytesIO()
    view.save(jpeg, "JPEG", quality=quality)
    return "data:image/jpeg;base64," + packed(jpeg.getvalue())


def map_points(result: SlamResult) -> dict[str, object] | None:
    """Return points that keyframes saw, each in its own camera's frame; None without images.

    Axes and colours of all are packed as whole numbers, keyframe after keyframe, so that the page
    can put them where the keyframes were at every stage.
    """
    is_placed = np.isfinite(result.T_world_kf[:, 0, 0])
    if not result.has_images or not is_placed.any():
        return None
    placed = [
        each for each, has_place in zip(result.keyframes, is_placed, strict=True) if has_place
    ]
    chosen = placed[:: -(-len(placed) // _MOST_KEYFRAMES)]
    height, width = chosen[0].preview.depth_m.shape
    stride = max(1, int(np.ceil((height * width * len(chosen) / _MOST_POINTS) ** 0.5)))
    first = slice(stride // 2, None, stride)
    depths_m = [each.preview.depth_m[first, first].astype(np.float64) for each in chosen]
    known_m = np.concatenate([each[each > 0.0] for each in depths_m])
    farthest_m = _FARTHEST * float(np.median(known_m)) if len(known_m) else 1.0
    kept, colours = [], []
    for keyframe, depth_m in zip(chosen, depths_m, strict=True):
        v, u = np.nonzero((depth_m > 0.0) & (depth_m <= farthest_m))
        pixels = (np.column_stack([u, v]) * stride + stride // 2) / PREVIEW_SCALE
        camera = keyframe.camera or result.camera
        kept.append(back_project(undistort(pixels, camera), depth_m[v, u], camera))
        colours.append(keyframe.preview.rgb[first, first][v, u])
    points_m: FloatArray = np.concatenate(kept)
    unit_m = float(np.abs(points_m).max(initial=1e-6)) / _STEPS
    return {
        "keyframes": [each.id for each in chosen],
        "counts": [len(each) for each in kept],
        "unit_m": unit_m,
        "points": packed(np.rint(points_m / unit_m).astype("<i2").tobytes()),
        "colours": packed(np.concatenate(colours).tobytes()),
    }


def packed(content: bytes) -> str:
    """Return bytes as base64, as the page unpacks them."""
    return base64.b64encode(content).decode("ascii")
