# SPDX-License-Identifier: Apache-2.0
"""The image files of a folder by the numbers in their names."""

import re
from pathlib import Path
from typing import NamedTuple

from slam.types import SlamError

_COLOR_KINDS = r"(?:png|jpe?g|bmp|ppm|pgm|tiff?|webp)"
_DEPTH_KINDS = r"(?:png|pgm|tiff?|npy|exr|pfm)"
ANY_IMAGE = re.compile(rf"\D*(\d+)(?:-\d+)?\.{_COLOR_KINDS}", re.IGNORECASE)
# Where none of a folder's names is as usual: the last number, such as 12 of cam0_12_raw.png.
_LAST_NUMBER = r"(?:.*[^\d.])?(\d+)[^\d.]*\."
_COLOR_NAMES = (ANY_IMAGE, re.compile(_LAST_NUMBER + _COLOR_KINDS, re.IGNORECASE))
_DEPTH_NAMES = (
    re.compile(rf"\D*(\d+)(?:-\d+)?\.{_DEPTH_KINDS}", re.IGNORECASE),
    re.compile(_LAST_NUMBER + _DEPTH_KINDS, re.IGNORECASE),
)

_MANY_UNPAIRED = 0.1


class NumberedPair(NamedTuple):
    """The images of one number; that of depth may be missing."""

    number: int
    color: Path
    depth: Path


def numbered_pairs(color: Path, depth: Path, warnings: list[str]) -> list[NumberedPair]:
    """Return the images of two folders, in the order of their numbers, a pair per colour image.

    Raises:
        SlamError: a folder has no image, or two of one number.
    """
    colors, depths = numbered_images(color), numbered_images(depth, *_DEPTH_NAMES)
    unpaired = len(depths.keys() - colors.keys())
    if unpaired > _MANY_UNPAIRED * len(depths):
        warnings.append(
            f"{unpaired} of {len(depths)} depth images have no colour image of their number and"
            " are not used"
        )
    return [
        NumberedPair(number, path, depths.get(number, depth / f"{path.stem}.png"))
        for number, path in colors.items()
    ]


def numbered_images(folder: Path, *names: re.Pattern[str]) -> dict[int, Path]:
    """Return the images of a folder by the number that the name's first group holds, in order.

    Of several patterns for names, colour images' unless told, the first that fits any is used.

    Raises:
        SlamError: there is none, or two have the same number.
    """
    found: dict[int, Path] = {}
    paths = [path for path in sorted(folder.iterdir()) if not path.name.startswith(".")]
    matches = [
        (match, path)
        for name in names or _COLOR_NAMES
        for path in paths
        if (match := name.fullmatch(path.name))
    ]
    for match, path in matches:
        if match.re is not matches[0][0].re:
            break
        number = int(match[1])
        if number in found:
            raise SlamError(
                f"two images have the number {number}, {found[number].name} and {path.name};"
                f" remove one: {folder}"
            )
        found[number] = path
    if not found:
        seen = ", ".join(path.name for path in paths[:3]) or "nothing"
        raise SlamError(
            f"the folder holds no numbered image that is read here, but {seen}: {folder}"
        )
    return dict(sorted(found.items()))
