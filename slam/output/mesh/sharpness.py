# SPDX-License-Identifier: Apache-2.0
"""How sharp a map is, which nobody needs the truth to tell: drift smears a wall or doubles it."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from slam.types import FloatArray, IntArray

_FEWEST = 10
"""Points within reach; fewer show no surface."""
_LEAST_M2 = 1e-12  # a variance: no depth camera sees micrometres, and log 0 is no number
_AT_ONCE = 500  # points whose neighbours are looked at together


@dataclass(frozen=True)
class Surroundings:
    """What lies about some of a map's points.

    Attributes:
        entropies: (Q,) nats, of the normal distribution that has the neighbours' covariance C,
            ln det(2 pi e C) / 2; NaN where there are too few.
        plane_variances_m2: (Q,) the least eigenvalue of C: how far the neighbours are off a plane.
    """

    entropies: FloatArray
    plane_variances_m2: FloatArray


def surroundings(points_m: FloatArray, chosen: IntArray, radius_m: float) -> Surroundings:
    """Return what lies within the radius of the chosen (Q,) of (N, 3) points.

    The means of both are the mean map entropy of Droeschel et al., ICRA 2014, and the mean plane
    variance of Razlaw et al., Evaluation of registration methods for sparse 3D laser scans, ECMR
    2015: lower is sharper. They compare maps of the same measurements only, for a denser map has
    other neighbours.
    """
    tree = cKDTree(points_m)
    found = [
        _about(tree, points_m, chosen[start : start + _AT_ONCE], radius_m)
        for start in range(0, len(chosen), _AT_ONCE)
    ]
    variances_m2 = np.concatenate(found) if found else np.zeros((0, 3))
    entropies = 0.5 * np.log(2.0 * np.pi * np.e * variances_m2).sum(axis=1)
    return Surroundings(entropies, variances_m2[:, 0])


def _about(tree: cKDTree, points_m: FloatArray, chosen: IntArray, radius_m: float) -> FloatArray:
    """Return (Q, 3) eigenvalues of the neighbours' covariances, rising; NaN where there are few."""
    neighbours = tree.query_ball_point(points_m[chosen], radius_m, return_sorted=True)
    counts = np.array([len(each) for each in neighbours])  # each point is its own neighbour
    starts = np.cumsum(counts) - counts
    # About the point itself, so that squares are small beside what they are told apart by.
    apart_m = points_m[np.concatenate(neighbours).astype(np.int64)]
    apart_m = apart_m - np.repeat(points_m[chosen], counts, axis=0)
    means_m = np.add.reduceat(apart_m, starts) / counts[:, None]
    products = (apart_m[:, :, None] * apart_m[:, None, :]).reshape(-1, 9)
    squares = (np.add.reduceat(products, starts) / counts[:, None]).reshape(-1, 3, 3)
    variances = np.linalg.eigvalsh(squares - means_m[:, :, None] * means_m[:, None, :])
    variances = np.maximum(variances, _LEAST_M2)
    variances[counts < _FEWEST] = np.nan
    return np.asarray(variances)
