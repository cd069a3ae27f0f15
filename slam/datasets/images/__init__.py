# SPDX-License-Identifier: Apache-2.0
"""Image files of recordings: which belong together, and what they hold."""

from placerec.datasets.times import FRAMES_PER_S
from slam.datasets.images.color import COLOR_FLAGS, color_bits, read_color
from slam.datasets.images.depth import depth_units, in_metres, is_depth, read_depth, read_size
from slam.datasets.images.exr import read_exr
from slam.datasets.images.numbered import (
    ANY_IMAGE,
    NumberedPair,
    numbered_images,
    numbered_pairs,
)

__all__ = [
    "ANY_IMAGE",
    "COLOR_FLAGS",
    "FRAMES_PER_S",
    "NumberedPair",
    "color_bits",
    "depth_units",
    "in_metres",
    "is_depth",
    "numbered_images",
    "numbered_pairs",
    "read_color",
    "read_depth",
    "read_exr",
    "read_size",
]
