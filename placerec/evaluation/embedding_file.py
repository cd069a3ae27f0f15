# SPDX-License-Identifier: Apache-2.0
"""The embeddings of the images of one folder, in a file; and many such files in one table."""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import Embeddings
from placerec.errors import RecognizerError
from placerec.evaluation.tables import csv_text, markdown_table
from placerec.files import arrays_of, read_bytes, write_atomically

SUFFIX = ".npz"
_MOST_BYTES = 4 << 30
_COLUMNS = ("data", "images", "skipped", "values", "failure")


@dataclass(frozen=True)
class EmbeddingFile:
    """What a file holds: each attribute is an array of it, by its name.

    Attributes:
        source: the data.
        fingerprint: of the recognizer.
        images: N paths.
        skipped: how many images could not be read, which are not among the N.
        embeddings: (N, *S) float32.
        timestamps_s: (N,) float64, None where they are not known, and not in the file.
    """

    source: str
    fingerprint: str
    images: tuple[str, ...]
    skipped: int
    embeddings: Embeddings
    timestamps_s: NDArray[np.float64] | None = None


def write_embedding_file(made: EmbeddingFile, path: Path) -> None:
    """Write a file that `numpy.load` reads; the same content is the same bytes.

    Raises:
        LoopcloseError: it cannot be written.
    """
    arrays: dict[str, Any] = {
        name: np.asarray(value) for name, value in vars(made).items() if value is not None
    }
    content = io.BytesIO()
    np.savez(content, **arrays)
    write_atomically(path, content.getvalue())


def read_embedding_file(path: Path) -> EmbeddingFile:
    """Return what a file holds.

    Raises:
        RecognizerError: it cannot be read, is damaged or something else.
    """
    try:
        arrays = arrays_of(read_bytes(path, _MOST_BYTES, kind=RecognizerError))
        return EmbeddingFile(
            str(arrays["source"]),
            str(arrays["fingerprint"]),
            tuple(map(str, arrays["images"])),
            int(arrays["skipped"]),
            arrays["embeddings"],
            arrays.get("timestamps_s"),
        )
    except (ValueError, KeyError, TypeError, OverflowError) as error:
        raise RecognizerError(f"not a file of embeddings, or damaged: {path}") from error


@dataclass(frozen=True)
class Embedded:
    """The line of a table that tells of embedded images.

    Attributes:
        name: of the data.
        images, skipped: how many there are, and how many could not be read.
        shape: of an embedding.
        why: there is nothing to tell; empty where there is.
    """

    name: str
    images: int = 0
    skipped: int = 0
    shape: tuple[int, ...] = ()
    why: str = ""

    @property
    def figures(self) -> dict[str, object]:
        """What a table shows of them, by its columns."""
        if self.why:
            return {"data": self.name, "failure": self.why}
        shape = " x ".join(map(str, self.shape))
        counts = {"images": self.images, "skipped": self.skipped}
        return {"data": self.name, **counts, "values": shape, "failure": ""}


def embedded_csv(rows: Sequence[Embedded]) -> str:
    """Return a line for each."""
    return csv_text(_COLUMNS, [row.figures for row in rows])


def embedded_table(rows: Sequence[Embedded]) -> str:
    """Return a Markdown table, a line for each."""
    cells = [
        (row.name, f"failed: {row.why}".replace("|", r"\|"))
        if row.why
        else tuple(str(row.figures[name]) for name in _COLUMNS[:-1])
        for row in rows
    ]
    return markdown_table(_COLUMNS[:-1], cells, names=1)
