# SPDX-License-Identifier: Apache-2.0
"""Where the camera went: RGB-D odometry, verified loop closures, a robust pose graph.

What is named here stays; everything else may move from one version to the next. A name is loaded
when it is first used, so that importing `slam` costs nothing.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from placerec.errors import LoopcloseError as LoopcloseError
    from slam.config import Config as Config
    from slam.datasets import open_sequence as open_sequence
    from slam.evaluation.drift import compare_drift as compare_drift
    from slam.evaluation.trajectory import read_tum as read_tum
    from slam.evaluation.trajectory import write_tum as write_tum
    from slam.loops.correction import Correction as Correction
    from slam.loops.saved_map import SavedMap as SavedMap
    from slam.loops.submaps import Loop as Loop
    from slam.loops.submaps import align_maps as align_maps
    from slam.loops.verification import verify_loop as verify_loop
    from slam.output.ledger.reading import read_ledger as read_ledger
    from slam.output.ledger.records import LoopRecord as LoopRecord
    from slam.output.live.view import LiveView as LiveView
    from slam.output.map_folder.folder import load_map as load_map
    from slam.output.map_folder.folder import save_map as save_map
    from slam.output.map_folder.folder import saved_map as saved_map
    from slam.output.map_folder.merging import merge_maps as merge_maps
    from slam.output.run_folder import write_run as write_run
    from slam.pose_graph.from_g2o import solve_g2o as solve_g2o
    from slam.result import SlamResult as SlamResult
    from slam.system import Slam as Slam
    from slam.tracking.tracked_frame import TrackedFrame as TrackedFrame
    from slam.types import Camera as Camera
    from slam.types import Features as Features
    from slam.types import Frame as Frame
    from slam.types import Keyframe as Keyframe
    from slam.types import LoopAttempt as LoopAttempt
    from slam.types import Rejection as Rejection
    from slam.types import SlamError as SlamError
    from slam.types import Trajectory as Trajectory

    __version__: str

_HOME = {
    "Camera": "slam.types",
    "Config": "slam.config",
    "Correction": "slam.loops.correction",
    "Features": "slam.types",
    "Frame": "slam.types",
    "Keyframe": "slam.types",
    "LiveView": "slam.output.live.view",
    "Loop": "slam.loops.submaps",
    "LoopAttempt": "slam.types",
    "LoopRecord": "slam.output.ledger.records",
    "LoopcloseError": "placerec.errors",
    "Rejection": "slam.types",
    "SavedMap": "slam.loops.saved_map",
    "Slam": "slam.system",
    "SlamError": "slam.types",
    "SlamResult": "slam.result",
    "TrackedFrame": "slam.tracking.tracked_frame",
    "Trajectory": "slam.types",
    "align_maps": "slam.loops.submaps",
    "compare_drift": "slam.evaluation.drift",
    "load_map": "slam.output.map_folder.folder",
    "merge_maps": "slam.output.map_folder.merging",
    "open_sequence": "slam.datasets",
    "read_ledger": "slam.output.ledger.reading",
    "read_tum": "slam.evaluation.trajectory",
    "save_map": "slam.output.map_folder.folder",
    "saved_map": "slam.output.map_folder.folder",
    "solve_g2o": "slam.pose_graph.from_g2o",
    "verify_loop": "slam.loops.verification",
    "write_run": "slam.output.run_folder",
    "write_tum": "slam.evaluation.trajectory",
}

__all__ = sorted([*_HOME, "__version__"])


def __getattr__(name: str) -> object:
    if name == "__version__":
        return version("loopclose")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return __all__
