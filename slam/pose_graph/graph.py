# SPDX-License-Identifier: Apache-2.0
"""The graph of keyframes that links, steps and loops connect, and what its solution says."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from slam.types import FloatArray, Link

_SMALL = 500  # keyframes: those that can be adjusted at once


@dataclass(frozen=True)
class PoseGraph:
    """Keyframe poses connected by motions: links are believed, loops have to agree with them.

    The links say how well the odometry knows what it made of the keyframes, so they fit the poses
    that the graph begins with: without a loop or a step that is its solution.

    Attributes:
        T_world_kf: (4, 4) by keyframe id, where the odometry has them; the first one stays.
        links: they connect all keyframes.
        loops: by a key that their weight is found by.
        steps: what an odometry from elsewhere measured, believed as the links are.
        solved: (4, 4) by keyframe id, an earlier solution; all but a small one begins there.
        is_planar: whether motions differ by three numbers only, as those of a 2-D graph.
    """

    T_world_kf: Mapping[int, FloatArray]
    links: Sequence[Link]
    loops: Mapping[int, Link]
    steps: Sequence[Link] = ()
    solved: Mapping[int, FloatArray] = field(default_factory=dict)
    is_planar: bool = False

    @property
    def is_large(self) -> bool:
        """Whether there are too many keyframes for any start but an earlier solution."""
        return len(self.T_world_kf) > _SMALL


@dataclass(frozen=True)
class GraphSolution:
    """What a solved graph says.

    Attributes:
        T_world_kf: (4, 4) float64 by keyframe id, metres.
        weights: trust per loop key, 0 (ignored) to 1.
        warnings: one sentence each.
        squared_errors: per loop key, in units of the loop's covariance; on the way nobody asks.
        limit: the squared error from which a loop is ignored.
    """

    T_world_kf: dict[int, FloatArray]
    weights: dict[int, float]
    warnings: tuple[str, ...] = ()
    squared_errors: Mapping[int, float] = field(default_factory=dict)
    limit: float = math.inf
