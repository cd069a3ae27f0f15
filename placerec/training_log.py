# SPDX-License-Identifier: Apache-2.0
"""One line per training step, as CSV."""

from dataclasses import astuple, dataclass, fields
from pathlib import Path

from pydantic import TypeAdapter

from placerec.output_file import write_atomically
from placerec.recognizer import RecognizerError


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


NAMES = [field.name for field in fields(StepRecord)]
_RECORD = TypeAdapter(StepRecord)


class TrainingLog:
    """A CSV file that grows by a line per step and forgets steps that will be made again."""

    def __init__(self, path: Path, last_step: int) -> None:
        """Go on with a log after a step; what it says of later ones is removed.

        Raises:
            RecognizerError: it cannot be read or written, or is no training's.
        """
        self._path = path
        kept = [record for record in read_log(path) if record.step <= last_step]
        lines = [NAMES, *(_row(record) for record in kept)]
        write_atomically(path, "".join(",".join(line) + "\n" for line in lines).encode())

    def add(self, record: StepRecord) -> None:
        """Write a line.

        Raises:
            RecognizerError: it cannot be written.
        """
        try:
            with self._path.open("a", newline="", encoding="utf-8") as file:
                file.write(",".join(_row(record)) + "\n")
        except OSError as error:
            raise RecognizerError(
                f"cannot write the log: {error.strerror}: {self._path}"
            ) from error


def read_log(path: Path) -> list[StepRecord]:
    """Return what each step of a log did, nothing where there is no log.

    Raises:
        RecognizerError: it cannot be read, or is no training's.
    """
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError) as error:
        raise RecognizerError(f"cannot read the log: {error}: {path}") from error
    # The last line ends in no line break where a process was killed within it.
    header, *rows = [line.split(",") for line in text.split("\n")[:-1]] or [NAMES]
    try:
        if header != NAMES:
            raise ValueError
        return [_RECORD.validate_python(dict(zip(NAMES, row, strict=True))) for row in rows]
    except ValueError as error:
        raise RecognizerError(
            f"the file is no log of a training; remove it or choose another folder: {path}"
        ) from error


def _row(record: StepRecord) -> list[str]:
    values = astuple(record)
    return [f"{value:.6g}" if isinstance(value, float) else str(value) for value in values]
