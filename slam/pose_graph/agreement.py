# SPDX-License-Identifier: Apache-2.0
"""What to doubt about the loops a robust solve kept."""

from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.pose_graph.batch import factor_errors

_LOOK = "look at the loop ledger before trusting the result"


def disagreements(
    graph: gtsam.NonlinearFactorGraph,
    initial: gtsam.Values,
    loops: Sequence[int],
    kept: NDArray[np.bool_],
) -> tuple[str, ...]:
    """Return one sentence for each thing to doubt: all loops rejected, estimators that differ.

    Args:
        graph: factors; all but the loops are believed.
        initial: one pose per key, from odometry.
        loops: positions of the L doubtful factors in the graph.
        kept: (L,) bool, loops that the robust solve believes.
    """
    if not kept.any():
        return (
            f"all {len(loops)} loops contradict the odometry or each other and were ignored; "
            f"{_LOOK}",
        )
    differ = int(np.sum(kept != _second_opinion(graph, initial, loops)))
    if not differ:
        return ()
    return (
        f"two robust estimators differ on {differ} of {len(loops)} loops "
        f"({int(kept.sum())} were kept); {_LOOK}",
    )


def _second_opinion(
    graph: gtsam.NonlinearFactorGraph, initial: gtsam.Values, loops: Sequence[int]
) -> NDArray[np.bool_]:
    """Return the (L,) bool loops that a Cauchy kernel trusts by more than half."""
    kernel = gtsam.noiseModel.mEstimator.Cauchy(1.0)
    robust = gtsam.NonlinearFactorGraph()
    doubtful = set(loops)
    for i in range(graph.size()):
        factor: Any = graph.at(i)
        if i in doubtful:
            noise = gtsam.noiseModel.Robust.Create(kernel, factor.noiseModel())
            factor = factor.cloneWithNewNoiseModel(noise)
        robust.add(factor)
    values = gtsam.LevenbergMarquardtOptimizer(robust, initial).optimize()
    return factor_errors(graph, values)[list(loops)] < 0.5 * 16.8
