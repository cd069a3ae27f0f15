# SPDX-License-Identifier: Apache-2.0
"""What to doubt about the loops that a robust solve kept."""

from collections.abc import Sequence
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from slam.pose_graph.batch import factor_errors
from slam.pose_graph.robust import RobustSolution
from slam.types import MIN_TRUSTED_WEIGHT

# A motion is contested where one estimator believes it and to the other its error is more than this
# many times the limit, twice the residual: those near the limit bend the map little either way.
_CLEARLY_OUT = 4.0
_ADVICE = "look at them in the loop ledger before trusting the result"


def contested_motions(
    graph: gtsam.NonlinearFactorGraph,
    initial: gtsam.Values,
    doubted: Sequence[int],
    solution: RobustSolution,
) -> NDArray[np.bool_]:
    """Return the (D,) bool motions that the solution and a Cauchy kernel see clearly differently.

    Args:
        graph: factors; all but the doubted ones are believed.
        initial: one pose per key, from odometry.
        doubted: positions of the D factors in the graph that may be wrong.
        solution: what the robust solve made of them.
    """
    limits = solution.limits[doubted]
    first = solution.errors[doubted] / limits
    kernel_width = float(np.sqrt(2.0 * limits.min()))
    cauchy = gtsam.noiseModel.mEstimator.Cauchy(kernel_width)
    second = factor_errors(graph, _reweighted(graph, initial, doubted, cauchy))[doubted] / limits
    kept = solution.weights[doubted] > MIN_TRUSTED_WEIGHT
    return np.where(kept, second > _CLEARLY_OUT, (second < 1.0) & (first > _CLEARLY_OUT))


def doubts(kept: NDArray[np.bool_], contested: NDArray[np.bool_]) -> tuple[str, ...]:
    """Return a sentence where all loops were rejected or a second estimator sees them otherwise.

    Args:
        kept: (L,) bool, loops that the robust solve believes.
        contested: (L,) bool, loops that a second estimator sees otherwise.
    """
    if not len(kept):
        return ()
    if not kept.any():
        return (
            f"all {len(kept)} loops contradict the odometry or each other and were left out, so "
            f"the trajectory is the odometry's; {_ADVICE}",
        )
    if not contested.any():
        return ()
    return (
        f"two robust estimators disagree on {contested.sum()} of {len(kept)} loops "
        f"({kept.sum()} were kept, {(contested & kept).sum()} of them contested); {_ADVICE}",
    )


def _reweighted(
    graph: gtsam.NonlinearFactorGraph,
    initial: gtsam.Values,
    doubted: Sequence[int],
    kernel: gtsam.noiseModel.mEstimator.Base,
) -> gtsam.Values:
    """Return the poses that iteratively reweighted least squares finds."""
    softened = graph.clone()
    for i in doubted:
        factor: Any = graph.at(i)
        noise = gtsam.noiseModel.Robust.Create(kernel, factor.noiseModel())
        softened.replace(i, factor.cloneWithNewNoiseModel(noise))
    return gtsam.LevenbergMarquardtOptimizer(softened, initial).optimize()
