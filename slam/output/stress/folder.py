# SPDX-License-Identifier: Apache-2.0
"""The folder of a stress: each trial in a file of its own, so that whoever stops can go on."""

import json
from collections.abc import Mapping
from pathlib import Path

from placerec.files import read_json, write_atomically
from slam.output.stress.outcome import Outcome, read_outcome, write_outcome
from slam.output.stress.stressors import STRESSORS
from slam.types import SlamError

_ASKED, _TRIALS = "stress.json", "trials"
_VERSION = 1
"""Of what the files hold: larger whenever trials of the one before are not to be mixed in."""


class StressFolder:
    """What was asked, the clean run's measurements, and the trials so far.

    Attributes:
        clean: the file of what the clean run measured.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.clean = path / "clean.npz"

    def begin(self, asked: Mapping[str, object]) -> None:
        """Make the folder that of a stress; one that was begun is gone on with.

        Raises:
            LoopcloseError: it is that of another one, or holds somebody's files of these names.
        """
        asked, file = {"version": _VERSION, **asked}, self._path / _ASKED
        if file.exists():
            before = read_json(file)
            known = before if isinstance(before, dict) else {}
            differing = [name for name, value in asked.items() if known.get(name) != value]
            if differing:
                raise SlamError(
                    f"the folder holds a stress with another {' and '.join(differing)}; choose"
                    f" another with --out: {self._path}"
                )
            self._make_trials()  # whoever wants them anew removes the folder
            return
        taken = [each for each in self._ours() if each.exists()]
        if taken:
            raise SlamError(
                f"the folder holds a {taken[0].name} that is not known to be of a stress; choose"
                f" another with --out: {self._path}"
            )
        write_atomically(file, json.dumps(asked, indent=2) + "\n")  # first, or it is nobody's
        self._make_trials()

    def keep(self, outcome: Outcome) -> None:
        """Write a trial, whole or not at all.

        Raises:
            LoopcloseError: it cannot be written.
        """
        write_outcome(self._trial(outcome.stressor, outcome.level), outcome)

    def trial(self, stressor: str, level: float) -> Outcome | None:
        """Return one that was kept, None where it was not."""
        return read_outcome(self._trial(stressor, level))

    def trials(self) -> dict[str, list[Outcome]]:
        """Return all that were kept by stressor, the levels rising."""
        found = {
            name: [each for level in stressor.levels if (each := self.trial(name, level))]
            for name, stressor in STRESSORS.items()
        }
        return {name: some for name, some in found.items() if some}

    def write(self, contents: Mapping[str, bytes | str]) -> None:
        """Write files by name.

        Raises:
            LoopcloseError: one cannot be written.
        """
        for name, content in contents.items():
            write_atomically(self._path / name, content)

    def _make_trials(self) -> None:
        try:
            (self._path / _TRIALS).mkdir(exist_ok=True)
        except OSError as error:
            raise SlamError(f"cannot make the folder: {error.strerror}: {self._path}") from error

    def _trial(self, stressor: str, level: float) -> Path:
        return self._path / _TRIALS / f"{stressor}-{level:g}.json"

    def _ours(self) -> list[Path]:
        names = ("clean.npz", _TRIALS, *(f"tolerance.{kind}" for kind in ("csv", "json", "png")))
        return [self._path / name for name in names]
