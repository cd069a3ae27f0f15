# SPDX-License-Identifier: Apache-2.0
"""What a hand-held camera does to a view of the same place: turns, shifts, blurs, other light."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8]


@dataclass(frozen=True)
class Augmentation:
    """How far a view may be changed; zero everywhere changes nothing.

    Attributes:
        brightness: largest change of exposure, of gamma (half of it) and of each colour (a
            quarter), as a natural logarithm.
        blur: longest streak of motion blur, as a share of the image's width.
        crop: largest share of each side that is cut away, below 1.
        perspective: largest shift of a corner, as a share of each side, below 0.5.
        roll_deg: largest rotation in the image plane.
    """

    brightness: float = 0.4
    blur: float = 0.02
    crop: float = 0.2
    perspective: float = 0.08
    roll_deg: float = 15.0

    def __call__(self, image: Image, rng: np.random.Generator) -> Image:
        """Return a changed copy, of the same shape, of a (H, W, 3) uint8 image."""
        return self._relit(self._blurred(self._moved(image, rng), rng), rng)

    def _moved(self, image: Image, rng: np.random.Generator) -> Image:
        height, width = image.shape[:2]
        size = np.array([width, height], np.float64)
        corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * size / 2.0
        kept = 1.0 - self.crop * rng.random()
        roll_rad = np.deg2rad(self.roll_deg) * rng.uniform(-1.0, 1.0)
        cosine, sine = np.cos(roll_rad), np.sin(roll_rad)
        turn = np.array([[cosine, sine], [-sine, cosine]])
        seen = kept * corners @ turn + self.perspective * rng.uniform(-1.0, 1.0, (4, 2)) * size
        seen += (1.0 - kept) / 2.0 * rng.uniform(-1.0, 1.0, 2) * size
        to_seen = cv2.getPerspectiveTransform(
            (corners + size / 2.0).astype(np.float32), (seen + size / 2.0).astype(np.float32)
        )
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        moved = cv2.warpPerspective(
            image, to_seen, (width, height), flags=flags, borderMode=cv2.BORDER_REFLECT_101
        )
        return np.asarray(moved, np.uint8)

    def _blurred(self, image: Image, rng: np.random.Generator) -> Image:
        reach_px = self.blur * image.shape[1] * rng.random() / 2.0
        angle_rad = rng.uniform(0.0, np.pi)
        half_px = int(np.ceil(reach_px))
        if half_px == 0:
            return image
        kernel = np.zeros((2 * half_px + 1, 2 * half_px + 1), np.float32)
        for t in np.linspace(-1.0, 1.0, 4 * half_px + 1):
            x, y = t * reach_px * np.cos(angle_rad), t * reach_px * np.sin(angle_rad)
            kernel[half_px + round(y), half_px + round(x)] += 1.0
        return np.asarray(cv2.filter2D(image, -1, kernel / kernel.sum()), np.uint8)

    def _relit(self, image: Image, rng: np.random.Generator) -> Image:
        exposure, gamma = np.exp(self.brightness * rng.uniform(-1.0, 1.0, 2) * [1.0, 0.5])
        tint = np.exp(self.brightness / 4.0 * rng.uniform(-1.0, 1.0, 3))
        levels = np.linspace(0.0, 1.0, 256)[:, None] ** gamma * exposure * tint
        table = np.clip(np.rint(255.0 * levels), 0.0, 255.0).astype(np.uint8)
        return np.stack([table[image[..., c], c] for c in range(3)], axis=2)
