# SPDX-License-Identifier: Apache-2.0
"""What a recognizer's threshold was calibrated on, kept as a JSON file beside its weights."""

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from placerec.output_file import write_atomically
from placerec.recognizer import RecognizerError

USUALLY_OUTSIDE = 0.02
"""The share of the calibration's own similarities that its range leaves out, half on each side."""
MAX_OUTSIDE = 0.1

Cosine = Annotated[float, Field(ge=-1.001, le=1.001)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Count = Annotated[int, Field(ge=0)]


class Certificate(BaseModel):
    """The threshold with the largest recall among those without an error, and its evidence.

    Attributes:
        recognizer: name it was loaded by.
        fingerprint: of what decides its embeddings.
        data: name of the dataset.
        images, skipped: how many were used, and how many could not be read.
        pairs, same_place_pairs: how many counted, and how many of these show one place.
        threshold: similarity from which two images are taken for one place.
        highest_wrong: similarity of the most similar pair of different places.
        recall: share of the pairs of one place that the threshold recognises.
        threshold_interval, recall_interval: 95 % of the resamples lie within.
        resampled: what was drawn, with replacement.
        resamples, without_threshold: how many times, and how often every threshold had an error.
        seed: of the draws.
        similarity_range: all but the 1 % lowest and the 1 % highest similarities lie within.
        curve: threshold, precision, recall over all pairs; thinned out, the threshold's included.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    recognizer: str
    fingerprint: str
    data: str
    images: Count
    skipped: Count
    pairs: Count
    same_place_pairs: Count
    threshold: Cosine
    highest_wrong: Cosine
    recall: Share
    threshold_interval: tuple[Cosine, Cosine]
    recall_interval: tuple[Share, Share]
    resampled: Literal["places", "images"]
    resamples: Count
    without_threshold: Count
    seed: int
    similarity_range: tuple[Cosine, Cosine]
    curve: tuple[tuple[Cosine, Share, Share], ...]

    def outside_calibrated_range(self, similarities: NDArray[np.floating]) -> str | None:
        """Return a warning where live similarities are unlike those calibrated on, else None.

        Args:
            similarities: (M,) of pairs that could be loops, most of them of different places.
        """
        low, high = self.similarity_range
        outside = (similarities < low) | (similarities > high)
        share = float(outside.mean()) if outside.size else 0.0
        if share <= MAX_OUTSIDE:
            return None
        return (
            f"{share:.0%} of {outside.size} similarities lie outside {low:.3f} to {high:.3f}, "
            f"where {1 - USUALLY_OUTSIDE:.0%} lay when the threshold {self.threshold:.3f} was "
            f"calibrated on {self.data}: it may not hold here; calibrate on images like these"
        )


def write_certificate(certificate: Certificate, path: Path) -> None:
    """Write a certificate as a whole JSON file.

    Raises:
        RecognizerError: the file cannot be written.
    """
    write_atomically(path, certificate.model_dump_json(indent=1).encode() + b"\n")


def read_certificate(path: Path) -> Certificate:
    """Read a certificate back.

    Raises:
        RecognizerError: the file cannot be read or is no certificate.
    """
    try:
        return Certificate.model_validate_json(path.read_bytes())
    except OSError as error:
        raise RecognizerError(f"cannot read the certificate: {error.strerror}: {path}") from error
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(map(str, first["loc"]))
        what = f"{where}: {first['msg']}" if where else first["msg"]
        raise RecognizerError(f"not a calibration certificate ({what}): {path}") from error
