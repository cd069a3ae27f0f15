# SPDX-License-Identifier: Apache-2.0
"""What to doubt about the loops that a robust solve kept."""

from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.pose_graph.batch import factor_errors
from slam.pose_graph.robust import HOLDS, RobustSolution

# A loop is contested where one estimator believes it and to the other its error is more than this
# many times the limit, twice the residual: those near the limit bend the map little either way.
_CLEARLY_OUT = 4.0
_ADVICE = "look at them in the loop ledger before trusting the result"


def disagreements(
    graph: gtsam.NonlinearFactorGraph,
    initial: gtsam.Values,
    loops: Sequence[int],
    solution: RobustSolution,
) -> tuple[str, ...]:
    """Return a sentence where all loops were rejected or a second estimator sees them otherwise.

    Args:
        graph: factors; all but the loops are believed.
        initial: one pose per key, from odometry.
        loops: positions of the doubtful factors in the graph.
        solution: what the robust solve made of them.
    """
    kept = solution.weights[loops] > HOLDS
    if not len(kept):
        return ()
    if not kept.any():
        return (
            f"all {len(kept)} loops contradict the odometry or each other and were left out, so "
            f"the trajectory is the odometry's; {_ADVICE}",
        )
    contested = contested_loops(graph, initial, loops, solution)
    if not contested.any():
        return ()
    return (
        f"two robust estimators disagree on {contested.sum()} of {len(kept)} loops "
        f"({kept.sum()} were kept, {(contested & kept).sum()} of them contested); {_ADVICE}",
    )


def contested_loops(
    graph: gtsam.NonlinearFactorGraph,
    initial: gtsam.Values,
    loops: Sequence[int],
    solution: RobustSolution,
) -> NDArray[np.bool_]:
    """Return the (L,) bool loops that the solution and a Cauchy kernel see clearly differently.

    The arguments are those of `disagreements`.
    """
    limits = solution.limits[loops]
    first = solution.errors[loops] / limits
    kernel_width = float(np.sqrt(2.0 * limits.min()))
    cauchy = gtsam.noiseModel.mEstimator.Cauchy(kernel_width)
    second = factor_errors(graph, _reweighted(graph, initial, loops, cauchy))[loops] / limits
    kept = solution.weights[loops] > HOLDS
    return np.where(kept, second > _CLEARLY_OUT, (second < 1.0) & (first > _CLEARLY_OUT))


def _reweighted(
    graph: gtsam.NonlinearFactorGraph,
    initial: gtsam.Values,
    loops: Sequence[int],
    kernel: gtsam.noiseModel.mEstimator.Base,
) -> gtsam.Values:
    """Return the poses that iteratively reweighted least squares finds."""
    softened = graph.clone()
    for i in loops:
        factor: Any = graph.at(i)
        noise = gtsam.noiseModel.Robust.Create(kernel, factor.noiseModel())
        softened.replace(i, factor.cloneWithNewNoiseModel(noise))
    return gtsam.LevenbergMarquardtOptimizer(softened, initial).optimize()
