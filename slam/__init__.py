# SPDX-License-Identifier: Apache-2.0
"""Where the camera went: RGB-D odometry, verified loop closures, a robust pose graph.

What is named here stays; everything else may move from one version to the next. A name is loaded
when it is first used, so that importing `slam` costs nothing.
"""

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from slam.config import Config
    from slam.datasets import open_sequence
    from slam.evaluation.drift import compare_drift
    from slam.evaluation.trajectory import read_tum
    from slam.output.run_folder import write_run
    from slam.result import SlamResult
    from slam.system import Slam
    from slam.tracking.tracked_frame import TrackedFrame
    from slam.types import (
        Camera,
        Frame,
        Keyframe,
        LoopAttempt,
        Rejection,
        SlamError,
        Trajectory,
    )

    __version__: str

_HOME = {
    "Camera": "slam.types",
    "Config": "slam.config",
    "Frame": "slam.types",
    "Keyframe": "slam.types",
    "LoopAttempt": "slam.types",
    "Rejection": "slam.types",
    "Slam": "slam.system",
    "SlamError": "slam.types",
    "SlamResult": "slam.result",
    "TrackedFrame": "slam.tracking.tracked_frame",
    "Trajectory": "slam.types",
    "compare_drift": "slam.evaluation.drift",
    "open_sequence": "slam.datasets",
    "read_tum": "slam.evaluation.trajectory",
    "write_run": "slam.output.run_folder",
}

__all__ = [
    "Camera",
    "Config",
    "Frame",
    "Keyframe",
    "LoopAttempt",
    "Rejection",
    "Slam",
    "SlamError",
    "SlamResult",
    "TrackedFrame",
    "Trajectory",
    "__version__",
    "compare_drift",
    "open_sequence",
    "read_tum",
    "write_run",
]


def __getattr__(name: str) -> object:
    if name == "__version__":
        return version("loopclose")
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(_HOME[name]), name)


def __dir__() -> list[str]:
    return __all__
