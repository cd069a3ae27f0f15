# SPDX-License-Identifier: Apache-2.0
"""Many recordings, named on the command line or in a list, and what the run on each is called."""

import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from placerec.files import is_file, read_text
from slam.commands.opening import DEMO
from slam.types import SlamError

_LIST = ".txt"
_COMMENT, _IS = "#", " = "


@dataclass(frozen=True)
class NamedRecording:
    """A recording of many.

    Attributes:
        name: of the run on it, and of the folder of that.
        recording: as `run_slam` takes it; the path is absolute where there is one.
    """

    name: str
    recording: str


def named_recordings(typed: Sequence[str]) -> list[NamedRecording]:
    """Return the recordings that were named; a plain file NAME.txt is a list of them.

    A line of it is `RECORDING` or `NAME = RECORDING`, relative to the list, or begins with #.

    Raises:
        LoopcloseError: a list cannot be read, there is nothing in it, a name is no folder's, or two
            recordings have the same.
    """
    found = [each for text in typed for each in _of(text)]
    if not found:
        raise SlamError(f"there is no recording in {', '.join(typed) or 'what was typed'}")
    first: dict[str, NamedRecording] = {}
    for each in found:
        if Path(each.name).name != each.name or each.name in ("", ".."):
            raise SlamError(f"the run needs a name that a folder can have, not {each.name!r}")
        other = first.setdefault(each.name, each)
        if other is not each:
            raise SlamError(
                f"two runs would be called {each.name}; in a list, `NAME = RECORDING` names them:"
                f" {other.recording} and {each.recording}"
            )
    return found


def _of(text: str) -> Iterator[NamedRecording]:
    path = Path(text)
    if path.suffix != _LIST or not is_file(path):
        yield _named("", text, Path())
        return
    for line in read_text(path, kind=SlamError).splitlines():
        line = line.strip()
        if line and not line.startswith(_COMMENT):
            name, is_named, recording = line.partition(_IS)
            yield _named(*((name, recording) if is_named else ("", line)), path.parent)


def _named(name: str, text: str, folder: Path) -> NamedRecording:
    """Return a recording relative to a folder; what `run_slam` finds by its name stays as it is."""
    from placerec.datasets.names import benchmark_name, find_data  # slow: it loads cv2

    text = text.strip()
    path = folder / text
    is_elsewhere = not os.path.lexists(path) and (find_data(text) or benchmark_name(text))
    if text != DEMO and not is_elsewhere:
        text = os.path.abspath(path)  # noqa: PTH100  # which, unlike Path's, drops `..` and no links
    return NamedRecording(name.strip() or Path(text).resolve().name, text)
