# SPDX-License-Identifier: Apache-2.0
"""How a sequence that was named is opened: rendered, found, or fetched."""

import logging
from pathlib import Path
from typing import TYPE_CHECKING

from placerec.commands.console import note, progress_bar
from slam.config import InputConfig

if TYPE_CHECKING:
    from slam.datasets import Sequence

DEFAULT_RECOGNIZER = "learned"
DEMO = "demo"
_log = logging.getLogger("slam")


def opened(name: str, config: InputConfig, folder: Path) -> "Sequence":
    """Return a sequence, and warn of what is odd about it; the demo is kept in the folder.

    Raises:
        LoopcloseError: there is none of that name, or it cannot be read.
    """
    from slam.datasets import open_sequence, resolve

    if name != DEMO:
        with progress_bar("fetching", unit="B") as progress:
            path = resolve(name, progress)
    elif not (path := folder / "sequence").exists():
        from slam.demo.separate_process import render_apart

        with progress_bar("rendering", unit="frame") as progress:
            render_apart(path, progress)
    note(f"reading {path}")
    sequence = open_sequence(path, config)
    for warning in sequence.warnings:  # now, for they may tell why the run fails
        _log.warning("%s", warning)
    return sequence
