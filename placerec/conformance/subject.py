# SPDX-License-Identifier: Apache-2.0
"""The recognizer that is looked at."""

import traceback
from functools import cached_property
from pathlib import Path
from types import FrameType
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from placerec.comparison import COSINES, Comparer
from placerec.conformance.fresh_process import FreshRun, run_in_fresh_process
from placerec.conformance.pictures import Image, places
from placerec.recognizer import PlaceRecognizer, RecognizerError, load


class NamelessError(Exception):
    """Another recognizer of the kind cannot be made, for it was handed over without a name."""


class Subject:
    """A recognizer and, where it has one, the name that makes another of its kind.

    Attributes:
        recognizer: the recognizer.
        name: what `load` makes one by, None where it was handed over as an object.
    """

    def __init__(self, recognizer: PlaceRecognizer, name: str | None) -> None:
        self.recognizer = recognizer
        self.name = name

    def embed(self, image: Image) -> NDArray[Any]:
        """Return what the recognizer makes of a copy of an image, as an array.

        Raises:
            Exception: whatever the recognizer raises.
        """
        return np.asarray(self.recognizer.embed(image.copy()))

    @cached_property
    def embeddings(self) -> list[NDArray[Any]]:
        """What the recognizer makes of each of the places."""
        return [self.embed(image) for image in places()]

    @property
    def compares(self) -> bool:
        """Whether it compares its embeddings itself; if not, their cosine does."""
        return callable(getattr(self.recognizer, "compare", None))

    @property
    def comparer(self) -> Comparer:
        """What compares its embeddings, unchecked."""
        return cast(Comparer, self.recognizer) if self.compares else COSINES

    def another(self) -> "Subject":
        """Return a second one of its kind, made anew.

        Raises:
            NamelessError: it has no name.
            RecognizerError: none can be made.
        """
        return Subject(load(self._known_name()), self.name)

    @cached_property
    def fresh_run(self) -> FreshRun:
        """What one of its kind does in a Python of its own.

        Raises:
            NamelessError: it has no name.
            RecognizerError: it fails there.
        """
        return run_in_fresh_process(self._known_name())

    def _known_name(self) -> str:
        if self.name is None:
            raise NamelessError("there is no name to make another one by")
        return self.name

    def explain(self, error: Exception) -> str:
        """Return an exception as one line that ends in where the recognizer raised it."""
        text = " ".join(str(error).split())
        kind = "" if isinstance(error, RecognizerError) else type(error).__name__
        lines = [
            f" ({Path(frame.f_code.co_filename).name}:{line})"
            for frame, line in traceback.walk_tb(error.__traceback__)
            if self.owns(frame)
        ]
        return ": ".join(part for part in (kind, text) if part) + "".join(lines[-1:])

    def owns(self, frame: FrameType) -> bool:
        """Return whether the package that the recognizer comes from is running there."""
        running = str(frame.f_globals.get("__name__", ""))
        return running.split(".")[0] == type(self.recognizer).__module__.split(".")[0]
