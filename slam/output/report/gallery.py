# SPDX-License-Identifier: Apache-2.0
"""Pictures of loop decisions: both views side by side, their matches drawn as lines."""

import base64
from collections import defaultdict
from io import BytesIO

import numpy as np
from PIL import Image, ImageDraw

from slam.output.report.decision import ACCEPTED, FALSE, OUTVOTED, Decision
from slam.types import Camera, FloatArray

MAX_PICTURES = 60
WIDTH_PX = 480
DRAWN_AT = 2
"""Lines are drawn at this multiple of the final size and then averaged, for smooth edges."""

MAX_LINES = 50
INLIER, OUTLIER = (64, 230, 150), (235, 70, 60)


def choose(loops: list[Decision], limit: int = MAX_PICTURES) -> list[Decision]:
    """Return the decisions worth a picture: doubtful ones, a spread of accepted, near misses.

    False loops come first, then outvoted ones in up to half of the room. Accepted loops, spread
    over time, and rejections share what is left; of each reason the closest miss comes first.
    """
    groups: dict[str, list[Decision]] = defaultdict(list)
    for loop in loops:
        groups[loop.kind].append(loop)
    false = groups.pop(FALSE, [])[:limit]
    doubtful = false + groups.pop(OUTVOTED, [])[: (limit - len(false)) // 2]
    accepted = groups.pop(ACCEPTED, [])
    missed = nearest_misses(list(groups.values()))
    room = limit - len(doubtful)
    shown = spread(accepted, max(room // 2, room - len(missed)))
    return doubtful + shown + missed[: room - len(shown)]


def nearest_misses(groups: list[list[Decision]]) -> list[Decision]:
    """Return rejections of all reasons in turn, the closest to acceptance of each first."""
    ranked = [
        (rank, loop)
        for group in groups
        for rank, loop in enumerate(sorted(group, key=lambda one: one.shortfall))
    ]
    return [loop for _, loop in sorted(ranked, key=lambda pair: (pair[0], pair[1].shortfall))]


def spread(loops: list[Decision], number: int) -> list[Decision]:
    """Return the strongest loop (most inliers) of each of `number` equal slices of time."""
    if len(loops) <= number:
        return loops
    slices = np.array_split(np.arange(len(loops)), number) if number else []
    return [max((loops[i] for i in part), key=lambda loop: loop.inliers or 0) for part in slices]


def picture(loop: Decision, camera: Camera) -> str:
    """Return a JPEG data URI: the earlier view left, the later right, matches as lines."""
    views = [loop.match.preview.rgb, loop.query.preview.rgb]
    width = WIDTH_PX * DRAWN_AT // 2
    height = round(width * views[0].shape[0] / views[0].shape[1])
    canvas = Image.new("RGB", (2 * width, height))
    for left, view in zip((0, width), views, strict=True):
        canvas.paste(Image.fromarray(view).resize((width, height)), (left, 0))
    _draw_matches(canvas, loop, camera)
    canvas = canvas.reduce(DRAWN_AT)
    jpeg = BytesIO()
    canvas.save(jpeg, "JPEG", quality=72)
    return "data:image/jpeg;base64," + base64.b64encode(jpeg.getvalue()).decode("ascii")


def _draw_matches(canvas: Image.Image, loop: Decision, camera: Camera) -> None:
    check = loop.attempt.verification
    if check is None or len(check.pixels) == 0:
        return
    half = canvas.width / 2
    scale = np.array([half / camera.width, canvas.height / camera.height] * 2)
    ends = check.pixels * scale + np.array([0.0, 0.0, half, 0.0])
    pen = ImageDraw.Draw(canvas, "RGBA")
    inliers, outliers = ends[check.inlier_mask], ends[~check.inlier_mask]
    for line in thinned(outliers).tolist():
        pen.line(line, fill=(*OUTLIER, 110), width=1)
    for line in thinned(inliers).tolist():
        pen.line(line, fill=(*INLIER, 190), width=2)
    for u, v in inliers.reshape(-1, 2).tolist():
        pen.ellipse((u - 3, v - 3, u + 3, v + 3), fill=(*INLIER, 230))


def thinned(lines: FloatArray) -> FloatArray:
    """Return at most MAX_LINES of the (M, 4) lines, evenly chosen: more would hide the views."""
    step = -(-len(lines) // MAX_LINES) or 1
    return lines[::step]
