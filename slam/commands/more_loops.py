# SPDX-License-Identifier: Apache-2.0
"""`run_slam more-loops`: look for loops that a run did not try, without its images."""

from functools import partial
from typing import TYPE_CHECKING

from placerec.commands.console import progress_bar
from slam.commands.replay import Again, decide_again
from slam.config import Config

if TYPE_CHECKING:
    from slam.datasets.pose_files import PoseFile
    from slam.output.replay.measurements import Measurements
    from slam.system import Slam

_DESCRIPTION = """Look for loops that a run did not try, now that its map is solved.

  run_slam more-loops runs/fr1_desk        writes runs/fr1_desk-more-loops

Decides about the run again, as run_slam replay does, without its images. Then
keyframes whose views should overlap by the map, and the next most similar, are
verified as strictly as before; loops that hold join the graph, and it is done
again, three times at most, until none is found."""


def main(typed: list[str]) -> int:
    """Look again and return the exit code 0.

    Raises:
        LoopcloseError: something is wrong with what was typed, or with the run.
    """
    return decide_again(typed, Again("more-loops", _DESCRIPTION, _searched, needs_features=True))


def _searched(measured: "Measurements", settings: Config, poses: "PoseFile | None") -> "Slam":
    from slam.output.replay.replayed import SearchingSlam, fed

    assert measured.remembered is not None  # or it was refused
    shown = partial(progress_bar, "looking again", unit="pair")
    slam = SearchingSlam(measured.journal, settings, measured.remembered, shown)
    return fed(slam, measured.journal, poses)
