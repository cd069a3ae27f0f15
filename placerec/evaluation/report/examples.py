# SPDX-License-Identifier: Apache-2.0
"""Figures and photographs as parts of a page."""

import base64
from dataclasses import dataclass
from io import BytesIO

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageOps

from placerec.datasets import PlaceDataset
from placerec.errors import RecognizerError
from placerec.evaluation.precision_recall import BestMatches

WIDTH_PX, HEIGHT_PX, GAP_PX = 300, 225, 6
"""Each photograph of a pair is made to fit into this."""
QUALITY = 75


@dataclass(frozen=True)
class Drawing:
    """A figure as a data address, and what it shows in words."""

    address: str
    alt: str


@dataclass(frozen=True)
class Match:
    """A query beside the reference that it was taken for.

    Attributes:
        address: the photographs as a data address, None where they can no longer be read.
        is_right: whether both show one place.
        similarity: of the two.
        query, reference: names of the files.
    """

    address: str | None
    is_right: bool
    similarity: float
    query: str
    reference: str


def drawing(svg: bytes, alt: str) -> Drawing:
    """Return an SVG file for a page."""
    # A file of its own within the page: inner names of several drawings cannot get mixed up.
    return Drawing(_address("image/svg+xml", svg), alt)


def first_matches(dataset: PlaceDataset, matches: BestMatches) -> tuple[Match | None, Match | None]:
    """Return the most similar right and the most similar wrong match, None where there is none."""
    right, wrong = matches.first(right=True), matches.first(right=False)
    return (
        None if right is None else _match(dataset, matches, right),
        None if wrong is None else _match(dataset, matches, wrong),
    )


def _match(dataset: PlaceDataset, matches: BestMatches, index: int) -> Match:
    query = int(dataset.queries[matches.queries[index]])
    reference = int(dataset.references[matches.references[index]])
    try:
        address = _address("image/jpeg", _side_by_side(dataset[query], dataset[reference]))
    except RecognizerError:  # removed since it was embedded; the figures stand nevertheless
        address = None
    return Match(
        address=address,
        is_right=bool(matches.are_right[index]),
        similarity=float(matches.similarities[index]),
        query=dataset.paths[query].name,
        reference=dataset.paths[reference].name,
    )


def _side_by_side(query: NDArray[np.uint8], reference: NDArray[np.uint8]) -> bytes:
    canvas = Image.new("RGB", (2 * WIDTH_PX + GAP_PX, HEIGHT_PX), "white")
    for left, photograph in ((0, query), (WIDTH_PX + GAP_PX, reference)):
        image = ImageOps.contain(Image.fromarray(photograph), (WIDTH_PX, HEIGHT_PX))
        middle = ((WIDTH_PX - image.width) // 2 + left, (HEIGHT_PX - image.height) // 2)
        canvas.paste(image, middle)
    jpeg = BytesIO()
    canvas.save(jpeg, "JPEG", quality=QUALITY)
    return jpeg.getvalue()


def _address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
