# SPDX-License-Identifier: Apache-2.0
"""`run_slam merge`: saved maps made one, by loops between them."""

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from placerec.commands import usage
from placerec.commands.console import progress_bar, say
from placerec.recognizer import PlaceRecognizer, load
from slam.commands.opening import DEFAULT_RECOGNIZER
from slam.config import Config, load_config
from slam.types import SlamError

if TYPE_CHECKING:
    from slam.loops.saved_map import SavedMap
    from slam.output.map_folder.merging import MergedMaps
    from slam.output.map_folder.proposing import Pair

PROG = "run_slam merge"
_log = logging.getLogger("slam")
_DESCRIPTION = """Make one map of maps that were saved, by loops between them.

  run_slam merge maps/robot1 maps/robot2 --out maps/both
  run_slam merge maps/* --out maps/all --poses poses
  run_slam merge maps/* --out maps/all --store places

Loops are verified and weighed as in a run, and the map is adjusted to them. A
map that no loops join to the largest group is left apart, and it is said why."""


@dataclass(frozen=True)
class Arguments:
    """What run_slam merge was asked to do."""

    maps: Annotated[
        tuple[Path, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="MAP MAP ...", help_behavior_hint="(at least two)"),
    ]
    """Folders that run_slam --save wrote."""
    out: Annotated[Path, tyro.conf.arg(metavar="MAP")]
    """Folder to save the merged map in."""
    poses: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None
    """Folder for where keyframes were: a TUM file for each session, as the map numbers them."""
    store: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Store of places, see docs/place_store.md, that proposes which of many maps to compare."""
    recognizer: Annotated[str, tyro.conf.arg(metavar="NAME")] = DEFAULT_RECOGNIZER
    """The one that the maps were made with."""
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE.toml")] = None
    """TOML file with settings of loops, verification and graph."""


def main(typed: list[str]) -> int:
    """Merge the maps that were named and return the exit code 0.

    Raises:
        LoopcloseError: something is wrong with what was typed, or with a map.
    """
    told = usage.parsed(Arguments, PROG, _DESCRIPTION, typed)
    if len(told.maps) < 2:
        raise SlamError("merge needs two maps at least; see run_slam merge --help")
    names = [str(each) for each in told.maps]
    if twice := next((each for each in names if names.count(each) > 1), None):
        raise SlamError(f"this map is named twice: {twice}")
    # Loaded from here on, so that --help and typing errors answer at once.
    from slam.output.map_folder.folder import check_place, load_map, save_map
    from slam.output.map_folder.merging import merge_maps

    config = Config() if told.config is None else load_config(told.config)
    recognizer = load(told.recognizer)
    check_place(told.out, recognizer)
    maps = {str(each): load_map(each, recognizer, config) for each in told.maps}
    apart, pairs = {}, None
    if told.store is not None:
        pairs = _proposed(told.store, maps, recognizer, config)
        apart = _outside_the_group(maps, pairs)
        maps = {name: each for name, each in maps.items() if name not in apart}
        if len(maps) < 2:
            raise SlamError(f"by the store no two of the maps share places: {told.store}")
    with progress_bar("comparing", unit="keyframe") as progress:
        merged = merge_maps(maps, recognizer, config, progress, pairs)
    merged = replace(merged, apart=apart | merged.apart)
    if told.poses is not None:
        _write_poses(told.poses, merged)
    save_map(told.out, merged.the_map)
    _tell(merged, told.out)
    return 0


def _proposed(
    address: str, maps: "dict[str, SavedMap]", recognizer: PlaceRecognizer, config: Config
) -> "set[Pair]":
    from placerec.places.store import PlaceStore
    from slam.output.map_folder.proposing import proposed_pairs

    chosen = config.loop.min_similarity
    alike_from = chosen if isinstance(chosen, float) else recognizer.min_similarity
    with progress_bar("asking the store", unit="keyframe") as progress:
        pairs = proposed_pairs(maps, PlaceStore(address, recognizer), alike_from, progress)
    every = len(maps) * (len(maps) - 1) // 2
    say(f"the store proposes {len(pairs)} of {every} pairs of maps")
    return pairs


def _outside_the_group(maps: "dict[str, SavedMap]", pairs: "set[Pair]") -> dict[str, str]:
    """Return why each map is left apart that the pairs do not connect with the most keyframes."""
    from slam.output.map_folder.proposing import largest_group

    group = largest_group(maps, pairs)
    apart = {}
    for name in (each for each in maps if each not in group):
        others = [other for pair in pairs if name in pair for other in pair if other != name]
        shared = f"places with {', '.join(sorted(others))} alone" if others else "no place"
        apart[name] = f"{name} is left apart: by the store it shares {shared}"
    return apart


def _tell(merged: "MergedMaps", folder: Path) -> None:
    for each in merged.joins:
        say(
            f"{' - '.join(each.maps)}: {each.used} loops, of {each.verified} verified and"
            f" {each.candidates} candidates"
        )
    for sentence in (*merged.apart.values(), *merged.warnings):
        _log.warning("%s", sentence)
    for name, sessions in merged.sessions.items():
        say(f"{name} is session {', '.join(map(str, sessions))}")
    say(
        f"written: {len(merged.the_map.keyframes)} keyframes, {len(merged.the_map.loops)} loops:"
        f" {folder}"
    )


def _write_poses(folder: Path, merged: "MergedMaps") -> None:
    import numpy as np

    from slam.commands.measuring import write_files
    from slam.evaluation.trajectory import tum_lines
    from slam.types import Trajectory

    the_map = merged.the_map
    stamps_s = np.array([each.timestamp_s for each in the_map.keyframes])
    T_map_kf = np.array([each.T_odom_cam for each in the_map.keyframes])
    write_files(
        folder,
        {
            f"session-{number}.txt": "\n".join(
                tum_lines(Trajectory(stamps_s[chosen], T_map_kf[chosen]))
            )
            + "\n"
            for number in np.unique(the_map.sessions)
            if len(chosen := np.flatnonzero(the_map.sessions == number))
        },
    )
