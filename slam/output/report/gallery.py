# SPDX-License-Identifier: Apache-2.0
"""Pictures of loop decisions: both views side by side, their matches drawn as lines."""

import base64
from collections import defaultdict
from io import BytesIO

import numpy as np
from PIL import Image, ImageDraw

from slam.output.decision import ACCEPTED, FALSE, OUTVOTED, Decision
from slam.types import Camera

_WIDTH_PX = 480
_OVERSAMPLING = 2  # lines are drawn this much larger and then averaged, for smooth edges
_MAX_LINES = 50  # more would hide the views
_INLIER, _OUTLIER = (64, 230, 150), (235, 70, 60)


def choose(loops: list[Decision], limit: int = 60) -> list[Decision]:
    """Return the decisions worth a picture: doubtful ones, a spread of accepted, near misses.

    False loops come first, then outvoted ones in up to half of the places left. Accepted loops,
    spread over time, and rejections share the rest; of each reason the closest miss comes first.
    """
    groups: dict[str, list[Decision]] = defaultdict(list)
    for loop in loops:
        groups[loop.kind].append(loop)
    false = groups.pop(FALSE, [])[:limit]
    doubtful = false + groups.pop(OUTVOTED, [])[: (limit - len(false)) // 2]
    accepted = groups.pop(ACCEPTED, [])
    ranked = [
        (rank, loop)
        for group in groups.values()
        for rank, loop in enumerate(sorted(group, key=lambda loop: loop.shortfall))
    ]
    missed = [loop for _, loop in sorted(ranked, key=lambda pair: (pair[0], pair[1].shortfall))]
    remaining = limit - len(doubtful)
    shown = _spread(accepted, max(remaining // 2, remaining - len(missed)))
    return doubtful + shown + missed[: remaining - len(shown)]


def _spread(loops: list[Decision], number: int) -> list[Decision]:
    """Return the strongest loop (most inliers) of each of `number` equal slices of time."""
    if len(loops) <= number:
        return loops
    slices = np.array_split(np.arange(len(loops)), number) if number else []
    return [max((loops[i] for i in part), key=lambda loop: loop.inliers or 0) for part in slices]


def picture(loop: Decision, camera: Camera) -> str:
    """Return a JPEG data URI: the earlier view left, the later right, matches as lines."""
    views = [loop.match.preview.rgb, loop.query.preview.rgb]
    width = _WIDTH_PX * _OVERSAMPLING // 2
    height = round(width * views[0].shape[0] / views[0].shape[1])
    canvas = Image.new("RGB", (2 * width, height))
    for left, view in zip((0, width), views, strict=True):
        larger = Image.fromarray(view).resize((width, height), Image.Resampling.BILINEAR)
        canvas.paste(larger, (left, 0))
    _draw_matches(canvas, loop, camera)
    jpeg = BytesIO()
    canvas.reduce(_OVERSAMPLING).save(jpeg, "JPEG", quality=72)
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.getvalue()).decode("ascii")


def _draw_matches(canvas: Image.Image, loop: Decision, camera: Camera) -> None:
    check = loop.attempt.verification
    if check is None or not len(check.pixels):
        return
    half = canvas.width / 2
    scale = np.array([half / camera.width, canvas.height / camera.height] * 2)
    ends = check.pixels * scale + np.array([0.0, 0.0, half, 0.0])
    pen = ImageDraw.Draw(canvas, "RGBA")
    inliers, outliers = ends[check.inlier_mask], ends[~check.inlier_mask]
    for lines, fill, width in ((outliers, (*_OUTLIER, 110), 1), (inliers, (*_INLIER, 190), 2)):
        step = -(-len(lines) // _MAX_LINES) or 1
        for line in lines[::step].tolist():
            pen.line(line, fill=fill, width=width)
    for u, v in inliers.reshape(-1, 2).tolist():
        pen.ellipse((u - 3, v - 3, u + 3, v + 3), fill=(*_INLIER, 230))
