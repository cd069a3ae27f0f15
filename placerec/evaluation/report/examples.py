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

_WIDTH_PX, _HEIGHT_PX, _GAP_PX = 300, 225, 6
"""Each photograph of a pair is made to fit into this."""
_QUALITY = 75


@dataclass(frozen=True)
class PageFigure:
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


def page_figure(svg: bytes, alt: str) -> PageFigure:
    """Return an SVG file for a page."""
    # A file of its own within the page: inner names of several figures cannot get mixed up.
    return PageFigure(_address("image/svg+xml", svg), alt)


def first_matches(dataset: PlaceDataset, matches: BestMatches) -> tuple[Match | None, Match | None]:
    """Return the most similar right and the most similar wrong match, None where there is none."""
    right, wrong = (np.flatnonzero(matches.are_right == is_right) for is_right in (True, False))
    return _most_similar(dataset, matches, right), _most_similar(dataset, matches, wrong)


def _most_similar(
    dataset: PlaceDataset, matches: BestMatches, among: NDArray[np.int64]
) -> Match | None:
    if among.size == 0:
        return None
    index = among[np.argmax(matches.similarities[among])]
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
    pair = Image.new("RGB", (2 * _WIDTH_PX + _GAP_PX, _HEIGHT_PX), "white")
    for left, photograph in ((0, query), (_WIDTH_PX + _GAP_PX, reference)):
        image = ImageOps.contain(Image.fromarray(photograph), (_WIDTH_PX, _HEIGHT_PX))
        middle = ((_WIDTH_PX - image.width) // 2 + left, (_HEIGHT_PX - image.height) // 2)
        pair.paste(image, middle)
    jpeg = BytesIO()
    pair.save(jpeg, "JPEG", quality=_QUALITY)
    return jpeg.getvalue()


def _address(kind: str, content: bytes) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
