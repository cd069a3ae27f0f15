# SPDX-License-Identifier: Apache-2.0
"""What a recognizer's thresholds were calibrated on, kept as a JSON file beside its weights.

There are two thresholds, because two decisions are made. From `min_similarity` on a match is worth
verifying: one in a hundred pairs of different places are so alike, and geometry sorts those out.
From `threshold` on, the paper's tau, two images are taken for one place with no other evidence: one
in a thousand pairs of different places are so alike. Neither hangs on the single most similar pair.

Kinds of scenes differ in how alike their places look. What is missed is lost, and what geometry has
to refuse costs little, so of several kinds the lowest `min_similarity` is taken, but the highest
`threshold`. What they do to a kind that had no say is known by leaving out one after the other.
"""

import hashlib
import inspect
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from placerec.errors import RecognizerError
from placerec.files import MOST_SETTINGS_BYTES, read_text, write_atomically
from placerec.recognizer import PlaceRecognizer

TAIL = 0.01
"""The share of either sort of pair that its range leaves out, on each side."""
SURE = 0.001
"""The share of the pairs of different places that reach tau."""
_MAX_OUTSIDE = 0.1
_MAX_PASSING = 0.95
_FEW_PAIRS = 50
"""Fewer live pairs than this say nothing about the images they come from."""
_SUFFIX = ".certificate.json"

Cosine = Annotated[float, Field(ge=-1.001, le=1.001)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Count = Annotated[int, Field(ge=0)]


class Reached(BaseModel):
    """What a threshold does where it was not chosen.

    Attributes:
        threshold: that of all other kinds of scenes.
        different_places: share of the pairs of different places that reach it, and pass.
        same_place: share of the pairs of one place that reach it; the others are cut.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    threshold: Cosine
    different_places: Share
    same_place: Share


class Kind(BaseModel):
    """One of the kinds of scenes that a recognizer was calibrated on.

    Attributes:
        data: name of its dataset, or of the folder of its datasets.
        images, skipped: how many were used, and how many could not be read.
        pairs, same_place_pairs: how many counted, and how many of these show one place.
        resampled: what was drawn, with replacement.
        different_places, same_place: all but the 1 % lowest and the 1 % highest similarities of
            pairs of different places, and of one place, lie within.
        threshold: tau, which `SURE` of the pairs of different places reach.
        left_out_to_verify, left_out_tau: what the thresholds of all other kinds do here, None
            where there are no others.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    data: str
    images: Count
    skipped: Count
    pairs: Count
    same_place_pairs: Count
    resampled: Literal["places", "images"]
    different_places: tuple[Cosine, Cosine]
    same_place: tuple[Cosine, Cosine]
    threshold: Cosine
    left_out_to_verify: Reached | None = None
    left_out_tau: Reached | None = None

    @property
    def min_similarity(self) -> float:
        """From where a match is worth verifying: of different places, 1 % are so alike."""
        return min(1.0, self.different_places[1])


class Certificate(BaseModel):
    """From which similarity on to verify a match, and to believe it unseen, with the evidence.

    Attributes:
        version: of what a certificate holds.
        recognizer: name it was loaded by.
        fingerprint: of what decides its embeddings.
        kinds: what it was calibrated on.
        recall_to_verify, recall: share of the pairs of one place that reach `min_similarity`, and
            tau; the mean over the kinds.
        min_similarity_interval, threshold_interval, recall_interval: 95 % of the resamples lie
            within.
        resamples: how many times images were drawn.
        seed: of the draws.
        curve: similarity, share of the pairs of different places and of those of one place that
            reach it, means over the kinds; thinned out.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    version: Literal[2]
    recognizer: str
    fingerprint: str
    kinds: Annotated[tuple[Kind, ...], Field(min_length=1)]
    recall_to_verify: Share
    recall: Share
    min_similarity_interval: tuple[Cosine, Cosine]
    threshold_interval: tuple[Cosine, Cosine]
    recall_interval: tuple[Share, Share]
    resamples: Count
    seed: int
    curve: tuple[tuple[Cosine, Share, Share], ...]

    @property
    def data(self) -> str:
        """What it was calibrated on, for people."""
        return ", ".join(kind.data for kind in self.kinds)

    @property
    def pairs(self) -> int:
        """How many pairs of images counted."""
        return sum(kind.pairs for kind in self.kinds)

    @property
    def min_similarity(self) -> float:
        """From where a match is worth verifying in one of the kinds of scenes."""
        return min(kind.min_similarity for kind in self.kinds)

    @property
    def threshold(self) -> float:
        """Tau: from where two images are taken for one place in all kinds of scenes."""
        return max(kind.threshold for kind in self.kinds)

    @property
    def different_places(self) -> tuple[float, float]:
        """Where 98 % of the similarities of different places lay, in whichever kind."""
        low, high = np.array([kind.different_places for kind in self.kinds]).T
        return float(low.min()), float(high.max())

    @property
    def same_place(self) -> tuple[float, float]:
        """Where 98 % of the similarities of one place lay, in whichever kind."""
        low, high = np.array([kind.same_place for kind in self.kinds]).T
        return float(low.min()), float(high.max())

    @property
    def calibrated_range(self) -> tuple[float, float]:
        """Where 98 % of the similarities lay, however many of the pairs show one place."""
        ranges = np.array([self.different_places, self.same_place])
        return float(ranges.min()), float(ranges.max())

    def outside_calibrated_range(self, similarities: NDArray[np.floating]) -> str | None:
        """Return a warning where live similarities are unlike those calibrated on, else None.

        Unlike are many outside the range of both kinds of pairs; and hardly any below
        `min_similarity`, for then it sorts nothing out.

        Args:
            similarities: (M,) of pairs that could be loops.
        """
        count = similarities.size
        if count < _FEW_PAIRS:
            return None
        low, high = self.calibrated_range
        outside = float(((similarities < low) | (similarities > high)).mean())
        if outside > _MAX_OUTSIDE:
            return (
                f"{outside:.0%} of the {count} similarities lie outside {low:.3f} to {high:.3f}, "
                f"where nearly all lay when the recognizer was calibrated on {self.data}: its "
                "threshold may not hold here; calibrate on images like these"
            )
        passing = float((similarities >= self.min_similarity).mean())
        if passing > _MAX_PASSING:
            lowest = min(self.kinds, key=lambda kind: kind.min_similarity)
            return (
                f"{passing:.0%} of the {count} similarities reach {self.min_similarity:.3f}, as "
                f"{TAIL:.0%} did between different places when the recognizer was calibrated on "
                f"{lowest.data}: if this is not all one place, calibrate on images like these"
            )
        return None


def own_fingerprint(recognizer: PlaceRecognizer) -> str | None:
    """Return what a recognizer says that its embeddings depend on, None where it says nothing."""
    own = getattr(recognizer, "fingerprint", None)
    return own if isinstance(own, str) else None


def fingerprint(recognizer: PlaceRecognizer) -> str:
    """Return the recognizer's `fingerprint`, or where it has none, the hash of its source file.

    A recognizer with weights has a member `fingerprint: str` that changes when they do.

    Raises:
        RecognizerError: it has no fingerprint and no source file.
    """
    if (own := own_fingerprint(recognizer)) is not None:
        return own
    kind = type(recognizer)
    try:
        source = Path(inspect.getfile(kind)).read_bytes()
    except (TypeError, OSError) as error:
        raise RecognizerError(
            f"recognizer {kind.__name__!r} has no source file to tell versions of it apart; "
            "give it a member fingerprint: str"
        ) from error
    return f"sha256:{hashlib.sha256(source).hexdigest()}"


def certificate_of(recognizer: PlaceRecognizer) -> Certificate | None:
    """Return the recognizer's member `certificate`, None where it has none.

    Raises:
        RecognizerError: it cannot be read, is no certificate, or is of another version.
    """
    certificate = getattr(recognizer, "certificate", None)
    if certificate is None:
        return None
    title = f"recognizer {type(recognizer).__name__!r}"
    if not isinstance(certificate, Certificate):
        raise RecognizerError(
            f"{title} has a certificate that is a {type(certificate).__name__}; "
            "it must be what placerec.certificate.read_certificate returns"
        )
    if certificate.fingerprint != (own := fingerprint(recognizer)):
        raise RecognizerError(
            f"{title} has the certificate of another version, {certificate.fingerprint[:15]}... "
            f"instead of {own[:15]}...: calibrate this one, or remove the certificate"
        )
    return certificate


def certificate_path(weights: Path) -> Path:
    """Return where the certificate of a file of weights lies: beside it."""
    return weights.with_suffix(_SUFFIX)


def certificate_beside(weights: Path) -> Certificate | None:
    """Return the certificate that lies beside a file of weights, None where there is none.

    Raises:
        RecognizerError: it cannot be read or is no certificate.
    """
    path = certificate_path(weights)
    return read_certificate(path) if path.exists() else None


def write_certificate(certificate: Certificate, path: Path) -> None:
    """Write a certificate as a whole JSON file.

    Raises:
        LoopcloseError: the file cannot be written.
    """
    write_atomically(path, certificate.model_dump_json(indent=1).encode() + b"\n")


def read_certificate(path: Path) -> Certificate:
    """Read a certificate back.

    Raises:
        RecognizerError: the file cannot be read, is no certificate, or is one of before that has
            to be made anew.
    """
    text = read_text(path, MOST_SETTINGS_BYTES, what="the certificate", kind=RecognizerError)
    try:
        return Certificate.model_validate_json(text)
    except ValidationError as error:
        first = error.errors()[0]
        if first["loc"] == ("version",):
            raise RecognizerError(
                "a calibration certificate of another version of the package; make it anew with "
                f"`placerec calibrate`, or remove it: {path}"
            ) from error
        where = ".".join(map(str, first["loc"]))
        what = f"{where}: {first['msg']}" if where else first["msg"]
        raise RecognizerError(f"not a calibration certificate ({what}): {path}") from error
