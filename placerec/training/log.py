# SPDX-License-Identifier: Apache-2.0
"""One line per training step, as CSV."""

import io
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray
from pydantic import TypeAdapter

from placerec.errors import RecognizerError
from placerec.files import read_text, write_atomically


@dataclass(frozen=True)
class StepRecord:
    """What one step did.

    Attributes:
        step: 1, 2, 3, ...
        round: how often image sets were built, from 1.
        loss: mean over the step's sets.
        active_share: share of the step's sets that still cost something.
        sets_left: sets of this round that are still to come.
        learning_rate: of the fully connected layer.
        images_per_s: images learned from per second, in this step.
        elapsed_s: time spent so far, resumed parts and building of sets included.
        time_to_go_s: until the budget is spent, or, where there is none, the round is over.
    """

    step: int
    round: int
    loss: float
    active_share: float
    sets_left: int
    learning_rate: float
    images_per_s: float
    elapsed_s: float
    time_to_go_s: float


_NAMES = [field.name for field in fields(StepRecord)]
_RECORD = TypeAdapter(StepRecord)
_SMOOTHED_SHARE = 0.05
"""Share of all steps that a point of the plot's smooth line is the mean of."""


class TrainingLog:
    """A CSV file that grows by a line per step and forgets steps that will be made again."""

    def __init__(self, path: Path, last_step: int) -> None:
        """Go on with a log after a step; what it says of later ones is removed.

        Raises:
            RecognizerError: it cannot be read or written, or is no training's.
        """
        self._path = path
        kept = [_line(record) for record in read_log(path) if record.step <= last_step]
        write_atomically(path, "".join([",".join(_NAMES) + "\n", *kept]))

    def add(self, record: StepRecord) -> None:
        """Write a line.

        Raises:
            RecognizerError: it cannot be written.
        """
        try:
            with self._path.open("a", newline="", encoding="utf-8") as file:
                file.write(_line(record))
        except OSError as error:
            why = error.strerror
            raise RecognizerError(f"cannot write the log: {why}: {self._path}") from error


def read_log(path: Path) -> list[StepRecord]:
    """Return what each step of a log did, nothing where there is no log.

    Raises:
        RecognizerError: it cannot be read, or is no training's.
    """
    if not path.exists():
        return []
    text = read_text(path, what="the log", kind=RecognizerError)
    # The last line ends in no line break where a process was killed within it.
    header, *rows = [line.split(",") for line in text.split("\n")[:-1]] or [_NAMES]
    try:
        if header != _NAMES:
            raise ValueError
        return [_RECORD.validate_python(dict(zip(_NAMES, row, strict=True))) for row in rows]
    except ValueError as error:
        raise RecognizerError(
            f"the file is no log of a training; remove it or choose another folder: {path}"
        ) from error


def _line(record: StepRecord) -> str:
    values = astuple(record)
    return ",".join(f"{v:.6g}" if isinstance(v, float) else str(v) for v in values) + "\n"


def write_plot(records: Sequence[StepRecord], path: Path) -> None:
    """Write loss and share of sets that still cost something, step by step, as a PNG file.

    Raises:
        RecognizerError: it cannot be written.
    """
    steps = np.array([record.step for record in records])
    figure = Figure(figsize=(7.0, 5.0), dpi=120, layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    losses, shares = ([getattr(r, name) for r in records] for name in ("loss", "active_share"))
    for title, axes, values in (("loss", upper, losses), ("sets with a loss", lower, shares)):
        axes.plot(steps, values, color="#b8c4d0", linewidth=0.8, label="per step")
        axes.plot(steps, _smooth(values), color="#1f5fa8", label="moving mean")
        axes.set_ylabel(title)
        axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    upper.legend(frameon=False, loc="upper right")
    lower.set_xlabel("step")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    write_atomically(path, buffer.getvalue())


def _smooth(values: Sequence[float]) -> NDArray[np.float64]:
    """Return the (N,) means of what lies around each of (N,) values, fewer towards the ends."""
    half = int(_SMOOTHED_SHARE * len(values) / 2.0)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    middle = np.arange(len(values))
    start, stop = np.maximum(middle - half, 0), np.minimum(middle + half + 1, len(values))
    return np.asarray((sums[stop] - sums[start]) / (stop - start))
