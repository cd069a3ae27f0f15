# SPDX-License-Identifier: Apache-2.0
"""A furnished room made from a seed: recordings with exact truth, or frames while one watches.

`render_sequence` writes a recording. For single frames, `build_room` makes the room, `drive` the
poses of a camera that is carried round it, a lap in LAP_S, and `render` what it sees from one.
"""

from slam.demo.drive import LAP_S, drive
from slam.demo.recording import render_sequence
from slam.demo.room import Room, build_room, render

__all__ = ["LAP_S", "Room", "build_room", "drive", "render", "render_sequence"]
