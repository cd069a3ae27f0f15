# SPDX-License-Identifier: Apache-2.0
"""Where data lies that is named and not pointed to, such as `fr1_desk`."""

import os
from collections.abc import Iterator
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path

from placerec.files import cache_folder

_SEQUENCES = {
    "1": "360 desk desk2 floor plant room rpy teddy xyz",
    "2": "360_hemisphere 360_kidnap coke desk desk_with_person dishes flowerbouquet"
    " flowerbouquet_brownbackground large_no_loop large_with_loop metallic_sphere"
    " metallic_sphere2 pioneer_360 pioneer_slam pioneer_slam2 pioneer_slam3 rpy xyz",
    "3": "cabinet large_cabinet long_office_household nostructure_notexture_far"
    " nostructure_notexture_near_withloop nostructure_texture_far"
    " nostructure_texture_near_withloop sitting_halfsphere sitting_rpy sitting_static sitting_xyz"
    " structure_notexture_far structure_notexture_near structure_texture_far"
    " structure_texture_near teddy walking_halfsphere walking_rpy walking_static walking_xyz",
}
_SHORT_NAMES = tuple(f"fr{n}_{name}" for n, names in _SEQUENCES.items() for name in names.split())
_NICKNAMES = dict.fromkeys(("fr3_office", "fr3_long_office"), "fr3_long_office_household")


def find_data(name: str) -> Path | None:
    """Return where data is: a path, one under $LOOPCLOSE_DATA, or a sequence that is at hand.

    A name of the TUM RGB-D benchmark is looked for under $LOOPCLOSE_DATA, then in the user's cache
    folder; None where nothing is found.
    """
    for candidate in _candidates(name):
        with suppress(OSError, ValueError):  # such as a name too long for a path, or with a NUL
            if candidate.exists():
                return candidate
    return None


def _candidates(name: str) -> Iterator[Path]:
    yield Path(name)
    data = os.environ.get("LOOPCLOSE_DATA")
    short_name = benchmark_name(name)
    if short_name and data:
        yield from _sequences(Path(data), short_name)
    if short_name:
        yield from _sequences(cache_folder(), short_name)
    if data and name:
        yield Path(data) / name


def _sequences(root: Path, short_name: str) -> Iterator[Path]:
    for folder in (root / benchmark_folder(short_name), root / short_name):
        if (folder / "rgb.txt").is_file():
            yield folder


def benchmark_name(name: str) -> str | None:
    """Return the short name, such as fr1_desk, of a TUM RGB-D sequence; None if it is none."""
    plain = _plain(name)
    return plain if plain in _SHORT_NAMES else None


def benchmark_folder(short_name: str) -> str:
    """Return what the folder of a TUM RGB-D sequence is called in its archive."""
    return f"rgbd_dataset_freiburg{short_name[2:]}"


def did_you_mean(name: str) -> str:
    """Return a question for the benchmark's names that are close to one that is none; or ""."""
    close = get_close_matches(_plain(name), (*_SHORT_NAMES, *_NICKNAMES))
    return f"did you mean {' or '.join(close)}?" if close else ""


def _plain(name: str) -> str:
    plain = name.lower().strip("/").replace("-", "_").replace("/", "_")
    plain = plain.removeprefix("rgbd_dataset_").replace("freiburg", "fr", 1)
    return _NICKNAMES.get(plain, plain)
