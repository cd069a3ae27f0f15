# SPDX-License-Identifier: Apache-2.0
"""One line per training step, as CSV."""

import csv
import io
from dataclasses import astuple, dataclass, fields
from pathlib import Path

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


class TrainingLog:
    """A CSV file that grows by a line per step and forgets steps that will be made again."""

    def __init__(self, path: Path, last_step: int) -> None:
        """Go on with a log after a step; what it says of later ones is removed.

        Raises:
            RecognizerError: it cannot be read or written.
        """
        self._path = path
        names = [field.name for field in fields(StepRecord)]
        kept = [row for row in _rows(path) if int(row["step"]) <= last_step]
        buffer = io.StringIO()
        table = csv.DictWriter(buffer, names, extrasaction="ignore", lineterminator="\n")
        table.writeheader()
        table.writerows(kept)
        write_atomically(path, buffer.getvalue().encode())

    def add(self, record: StepRecord) -> None:
        """Write a line.

        Raises:
            RecognizerError: it cannot be written.
        """
        values = (
            f"{value:.6g}" if isinstance(value, float) else value for value in astuple(record)
        )
        try:
            with self._path.open("a", newline="", encoding="utf-8") as file:
                csv.writer(file, lineterminator="\n").writerow(values)
        except OSError as error:
            raise RecognizerError(
                f"cannot write the log: {error.strerror}: {self._path}"
            ) from error


def _rows(path: Path) -> list[dict[str, str]]:
    """Return the complete lines of a log; a process may have been killed within one."""
    try:
        with path.open(newline="", encoding="utf-8") as file:
            return [row for row in csv.DictReader(file) if None not in row.values()]
    except FileNotFoundError:
        return []
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise RecognizerError(f"cannot read the log: {error}: {path}") from error
