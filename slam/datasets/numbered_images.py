# SPDX-License-Identifier: Apache-2.0
"""Images that have a number in their names instead of a time."""

import re
from pathlib import Path
from typing import NamedTuple

from slam.types import SlamError

FRAMES_PER_S = 30.0
"""What numbers stand for where no time is given: all the cameras of these recordings ran at it."""

ANY_IMAGE = re.compile(r"\D*(\d+)(?:-\d+)?\.(?:png|jpe?g|bmp|ppm|tiff?)", re.IGNORECASE)

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
    colors, depths = numbered_images(color), numbered_images(depth)
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


def numbered_images(folder: Path, name: re.Pattern[str] = ANY_IMAGE) -> dict[int, Path]:
    """Return the images of a folder by the number that the name's first group holds, in order.

    Raises:
        SlamError: there is none, or two have the same number.
    """
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        match = name.fullmatch(path.name)
        if match is None:
            continue
        number = int(match[1])
        if number in found:
            raise SlamError(
                f"two images have the number {number}, {found[number].name} and {path.name};"
                f" remove one: {folder}"
            )
        found[number] = path
    if not found:
        raise SlamError(f"the folder holds no numbered image: {folder}")
    return dict(sorted(found.items()))
