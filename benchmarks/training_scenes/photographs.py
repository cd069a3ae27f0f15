# SPDX-License-Identifier: Apache-2.0
"""Real photographs pasted over drawn surfaces: the look of the world on shapes with exact poses."""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np

from slam.demo.panels import Panel
from slam.demo.textures import Image

_SMALLEST_TEXELS = 24


def paper(
    panels: Sequence[Panel],
    photographs: Sequence[Image],
    share: float,
    rng: np.random.Generator,
) -> list[Panel]:
    """Return the panels, some of them showing a piece of a photograph instead.

    Args:
        panels: not yet lit; those too small to show anything are left as they are.
        photographs: (h, w, 3) uint8 RGB each.
        share: of the panels that get one.
        rng: chooses panels, photographs and pieces.
    """
    return [
        replace(panel, texture=_piece(photographs[int(rng.integers(len(photographs)))], panel, rng))
        if min(panel.texture.shape[:2]) >= _SMALLEST_TEXELS and rng.random() < share
        else panel
        for panel in panels
    ]


def _piece(photograph: Image, panel: Panel, rng: np.random.Generator) -> Image:
    """Return a piece of the panel's shape, a quarter to all of the photograph, maybe mirrored."""
    height, width = panel.texture.shape[:2]
    rows, columns = photograph.shape[:2]
    scale = rng.uniform(0.25, 1.0) * min(columns / width, rows / height)
    w, h = max(1, int(width * scale)), max(1, int(height * scale))
    left, top = rng.integers(columns - w + 1), rng.integers(rows - h + 1)
    piece = photograph[top : top + h, left : left + w]
    if rng.random() < 0.5:
        piece = piece[:, ::-1]
    how = cv2.INTER_AREA if w > width else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(np.ascontiguousarray(piece), (width, height), interpolation=how))
