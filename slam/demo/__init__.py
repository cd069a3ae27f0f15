# SPDX-License-Identifier: Apache-2.0
"""Furnished rooms made from a seed, for sequences with exact ground truth."""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from slam.demo.recording import LAP_S, drive, render_sequence
    from slam.demo.room import build_room, render

__all__ = ["LAP_S", "build_room", "drive", "render", "render_sequence"]


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module("slam.demo.recording"), name)  # slow: it loads open3d
