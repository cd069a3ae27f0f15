# SPDX-License-Identifier: Apache-2.0
"""`run_slam reembed`: a saved map for another recognizer."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from placerec.commands import usage
from placerec.commands.console import note, progress_bar, say
from placerec.recognizer import load

PROG = "run_slam reembed"
_DESCRIPTION = """Embed the places of a saved map by another recognizer, without its recordings.

  run_slam reembed maps/desk --recognizer bag-of-words

What is embedded are the small images that the map keeps, enlarged. The map is
replaced once all are done, and all else in it stays as it is."""


@dataclass(frozen=True)
class Arguments:
    """What run_slam reembed was asked to do."""

    map: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MAP")]
    """Folder that run_slam --save wrote."""
    recognizer: Annotated[str, tyro.conf.arg(metavar="NAME")]
    """The one that runs on the map will use, named as for run_slam."""


def main(typed: list[str]) -> int:
    """Embed the map's places anew and return the exit code 0.

    Raises:
        LoopcloseError: something is wrong with what was typed, with the map or the recognizer.
    """
    told = usage.parsed(Arguments, PROG, _DESCRIPTION, typed)
    # Loaded from here on, so that --help and typing errors answer at once.
    from slam.output.map_folder.folder import check_place, read_map, save_map
    from slam.output.map_folder.reembedding import reembedded

    recognizer = load(told.recognizer)
    before = read_map(told.map)
    check_place(told.map, recognizer)
    with progress_bar("embedding", len(before.keyframes), "keyframe") as progress:
        after = reembedded(before, recognizer, progress=progress)
    if after.fingerprint == before.fingerprint:
        note("this recognizer made the map's embeddings before; they are made anew all the same")
    save_map(told.map, after)
    say(f"{len(after.keyframes)} keyframes are embedded by {told.recognizer}: {told.map}")
    return 0
