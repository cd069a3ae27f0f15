# SPDX-License-Identifier: Apache-2.0
"""A second opinion on the loops: the map grows from what the odometry can tell for sure.

GNC asks how many loops a map can satisfy, so ten that repeat one mistake count ten times, and may
bend an odometry beyond what it can be off. Here a loop has to be foretold: by the links and the
loops believed before it, with their uncertainty over the whole detour. What is believed makes the
next detour shorter. Nothing is believed for its number.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slam.geometry import se3
from slam.pose_graph.motion_system import MotionSystem
from slam.types import FloatArray

# How much likelier a loop has to be true than to tie two poses anywhere in the map, as a logarithm:
# as much as there is among many at once, else the likeliest first, for it makes others sure.
_SURE, _LEAST, _AS_SURE = (9.0, 7.0), 5.0, 0.5
# Of so many times as many loops one fits by chance.
_BEYOND_CHANCE = 3.0
# Reaches of loops that differ by no more octaves are alike.
_ALIKE, _LEAST_REACH_M = 0.5, 1e-3
_MOST_ROUNDS, _MOST_POSES = 150, 150_000  # of all rounds
_MOST_TRIALS = 3  # of a loop that others drove out again
_MOST_STEPS, _AT_REST = 10, 1e-3
_ENOUGH, _LEAST_SCALE = 20, 0.02
_LITTLE_TURN_RAD = 0.5
_PAIRS, _SEED = 2000, 1  # of poses that tell how large the map is


@dataclass(frozen=True)
class Consensus:
    """What the second opinion comes to.

    Attributes:
        T_world_kf: (K, 4, 4) float64, metres.
        kept: (L,) bool, the loops that agree with it.
        squared: (L,) float64, their squared errors in units of their covariance.
        undecided: (L,) bool, loops that may be true as far as is known, and as well may not.
        cost: the squared errors of all motions, of loops up to the wide limit.
        chance_fits: as many of the loops that were left out would fit by chance.
        is_complete: whether it came to an end, and to rest; in a large map of a poor odometry it
            may not.
    """

    T_world_kf: FloatArray
    kept: NDArray[np.bool_]
    squared: FloatArray
    undecided: NDArray[np.bool_]
    cost: float
    chance_fits: float
    is_complete: bool


def consensus(
    system: MotionSystem, limit: float, wide: float, by_gnc: NDArray[np.bool_]
) -> Consensus:
    """Return what grows from the links of a system.

    Beyond the limit of its squared error a loop is left out in the end, and beyond the wide one
    it is not taken for foretold. Where links know next to nothing, as between two recordings,
    nothing can be foretold: the first loops that lead over are those of L that GNC kept.
    """
    growth = _Growth(system, limit, wide, by_gnc & system.bridges)
    results = [growth.result()]
    for begins_anew in (False, True):
        if not results[-1].is_complete or not growth.thinks_again(begins_anew):
            break
        results.append(growth.result())
    return min(results, key=lambda result: (not result.is_complete, growth.cost(result)))


class _Growth:
    """A map that takes in one loop after the other."""

    def __init__(
        self, system: MotionSystem, limit: float, wide: float, given: NDArray[np.bool_]
    ) -> None:
        self._system, self._limit, self._wide = system, limit, wide
        self._given = self._kept = given
        self._T, self._is_at_rest = _settled(system, system.T_links, self._kept)
        # How sure a loop was when taken in, or left out at last; how far off what was foretold.
        self._evidence = np.where(given, np.inf, 0.0)
        self._foretold = np.zeros(system.loop_count)
        self._by_reach = np.zeros(system.loop_count)

    def result(self) -> Consensus:
        """Return what the map comes to once nothing more is sure enough."""
        system, scale = self._system, self._scale()
        trials = np.zeros(system.loop_count, np.int64)
        rounds = min(_MOST_ROUNDS, 1 + _MOST_POSES // len(self._T))
        for _ in range(rounds):
            draws = system.with_only(self._kept).draws(self._T)
            errors, covariance = system.predicted(self._T, draws)
            # Of the map as it is by now: the odometry alone may wander over much more.
            spread = _spread(self._T, system.is_planar)
            squared = squared_errors(errors, covariance)
            is_open = ~self._kept & (squared < scale * self._wide)
            evidence = _evidence(errors, scale * covariance, spread) + self._by_reach
            new = _next(np.where(is_open & (trials < _MOST_TRIALS), evidence, -np.inf))
            is_complete = not new.any()
            if is_complete:
                break
            trials += new
            self._evidence[new], self._foretold[new] = evidence[new], squared[new]
            self._move_to(self._kept | new)
            self._kept &= system.squared_errors(self._T) < self._wide
            scale = self._scale()
        still_open = np.where(is_open, evidence, -np.inf)
        self._evidence = np.where(self._kept, self._evidence, still_open)
        T, kept, squared, is_at_rest = self._polished()
        is_complete &= self._is_at_rest and is_at_rest
        cost = system.links_cost(T) + float(np.minimum(squared, self._wide).sum())
        fits = self._chance_of_fitting(scale * covariance[~kept], spread)
        return Consensus(T, kept, squared, is_open & ~kept, cost, float(fits.sum()), is_complete)

    def cost(self, result: Consensus) -> float:
        """Return the cost of a result, and of what it leaves out although its reach is usual."""
        return result.cost + 2.0 * float(self._by_reach[~result.kept].sum())

    def thinks_again(self, begins_anew: bool) -> bool:
        """Give up what may have fitted by chance, among so many that did not; say if it may differ.

        By then the reaches of loops tell more, and may speak for what was left out. Of a cluster
        that came in early every loop makes the others sure: only a map that begins anew can show
        that it was false.
        """
        by_reach = _evidence_by_reach(self._system.reaches_m, self._kept)
        self._evidence += by_reach - self._by_reach
        self._by_reach = by_reach
        left_out = ~self._kept
        may_come = _next(np.where(left_out, self._evidence, -np.inf)).any()
        weak = self._kept & (self._evidence < np.log1p(left_out.sum()) + _BEYOND_CHANCE)
        if not weak.any() and (begins_anew or not may_come):
            return False
        if begins_anew:
            self._T = self._system.T_links
        self._move_to(self._given if begins_anew else self._kept & ~weak)
        return True

    def _chance_of_fitting(self, covariance: FloatArray, spread: FloatArray) -> FloatArray:
        """Return (N,) how likely loops fit where they are foretold, if they are false.

        It is the share of the map that the ellipsoid of the wide limit covers.
        """
        half = 1.5 if self._system.is_planar else 3.0
        exact = _evidence(np.zeros((len(covariance), 6)), covariance, spread)
        share = (0.5 * self._wide) ** half / math.gamma(half + 1.0) * np.exp(-exact)
        return np.asarray(np.minimum(share, 1.0))

    def _move_to(self, kept: NDArray[np.bool_]) -> None:
        self._kept = kept
        self._T, self._is_at_rest = _settled(self._system, self._T, kept)

    def _scale(self) -> float:
        """Return how much smaller the covariances really are than they are said to be, 1 at most.

        Loops that came close were taken in first, so it is twice of what those show. Of those that
        were given nothing was foretold.
        """
        is_foretold = self._kept & np.isfinite(self._evidence)
        if np.count_nonzero(is_foretold) < _ENOUGH:
            return 1.0
        largest = float(np.quantile(self._foretold[is_foretold], 0.95))
        return min(max(2.0 * largest / self._limit, _LEAST_SCALE), 1.0)

    def _polished(self) -> tuple[FloatArray, NDArray[np.bool_], FloatArray, bool]:
        """Return the poses once exactly the loops within the limit are believed, these and errors.

        The last value says whether the poses came to rest.
        """
        T, kept = self._T, self._kept
        for _ in range(_MOST_STEPS):
            T, is_at_rest = _settled(self._system, T, kept)
            squared = self._system.squared_errors(T)
            before, kept = kept, squared < self._limit
            if (before == kept).all():
                break
        return T, kept, squared, is_at_rest


def _next(evidence: FloatArray) -> NDArray[np.bool_]:
    """Return the loops to be believed next."""
    for least in _SURE:
        if (evidence > least).any():
            return evidence > least
    best = float(evidence.max(initial=-np.inf))
    return (evidence > best - _AS_SURE) & (best > _LEAST)


def _evidence(errors: FloatArray, covariance: FloatArray, spread: FloatArray) -> FloatArray:
    """Return (L,) how much likelier loops are true than false, as a logarithm.

    A false loop is one between two poses that are anywhere in the map to each other.
    """
    return _log_density(errors, covariance) - _log_density(errors, covariance + spread)


def _log_density(errors: FloatArray, covariance: FloatArray) -> FloatArray:
    volume = np.linalg.slogdet(covariance)[1]
    return np.asarray(-0.5 * (squared_errors(errors, covariance) + volume))


def squared_errors(errors: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return (L,) squared errors of (L, 6) in units of their (L, 6, 6) covariance."""
    weighted = np.linalg.solve(covariance, errors[..., None])[..., 0]
    return np.asarray((errors * weighted).sum(axis=-1))


def _evidence_by_reach(reaches_m: FloatArray, kept: NDArray[np.bool_]) -> FloatArray:
    """Return (L,) how much likelier loops of such a reach are true than false, as a logarithm.

    What is seen together lies about as far apart as other such views; what fits by chance need not.
    A loop has no say about itself.
    """
    octaves = np.log2(np.maximum(reaches_m, _LEAST_REACH_M))
    shares = []
    for side in (kept, ~kept):
        known = np.sort(octaves[side])
        first, last = (np.searchsorted(known, octaves + off) for off in (-_ALIKE, _ALIKE))
        shares.append((1.0 + last - first - side) / (1.0 + len(known) - side))
    return np.asarray(np.log(shares[0] / shares[1]))


def _spread(T_world_kf: FloatArray, is_planar: bool) -> FloatArray:
    """Return the (6, 6) covariance of the motions between poses anywhere in the map.

    It is diagonal: those along a circle are all about one screw, but a false loop need not be. Nor
    does it look where a camera looks that hardly turns. Out of the plane of a planar graph nothing
    lies, neither true nor false.
    """
    a, b = np.random.default_rng(_SEED).integers(len(T_world_kf), size=(2, _PAIRS))
    motions = se3.log(se3.inverse(T_world_kf[a]) @ T_world_kf[b])
    variances = (motions**2).mean(axis=0)
    turns = slice(2, 3) if is_planar else slice(0, 3)
    if variances[turns].max() < _LITTLE_TURN_RAD**2:
        variances[turns] = _LITTLE_TURN_RAD**2
    return np.diag(variances)


def _settled(
    system: MotionSystem, T: FloatArray, kept: NDArray[np.bool_]
) -> tuple[FloatArray, bool]:
    """Return the (K, 4, 4) poses by links and kept loops, and whether they came to rest."""
    believed = system.with_only(kept)
    weights = np.ones(believed.loop_count)
    for _ in range(_MOST_STEPS):
        T, size = believed.step(T, weights)
        if size < _AT_REST:
            return T, True
    return T, False
