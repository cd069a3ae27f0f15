# SPDX-License-Identifier: Apache-2.0
"""From which similarity is a match worth verifying, among the images met here?

A calibrated threshold is of the images that it was calibrated on. On its way a camera meets both
populations that it should part, and knows them without recognising anything: views taken one after
the other are of one place while the camera has not gone far, and nearly all views that do not
follow each other are of different places. Only quantiles of both are used, for neither has a known
shape, and counts alone are kept, so that a long run takes no more memory than a short one.
"""

import numpy as np
from numpy.typing import NDArray

from slam.result import ThresholdFit
from slam.types import FloatArray

_MOST_CUT = 0.03
_MOST_PASSING = 0.25
"""What is aimed at, to stay within 5 % and 30 %: views seen again look a little less alike than
those that follow each other, and what was met until now is not all that will be."""
_PRIOR_PAIRS = 30.0
"""The calibrated threshold counts as much as so many pairs of one place."""
_BINS = 4096
_RINGS = 6
_RING_SHARES = np.diff((np.arange(_RINGS + 1) / _RINGS) ** 6)
"""How many of the views within the limit of a place lie in each sixth of it: poses have six
dimensions. The camera's own neighbours are nearer, and are weighed to be spread like these."""
_ONE_PLACE_FROM = 0.9
"""Where so many of all pairs seem to show one place, too few are left to judge the others by."""


class AdaptiveThreshold:
    """A threshold that moves from the calibrated one to where the pairs met here ask for it.

    It is the lower of two: that which nearly all pairs of one place reach, and that which a
    quarter of the others reach. So it lets as many pass as can be afforded, and more only where
    pairs of one place would be lost, for what passes wrongly is still verified.
    """

    def __init__(self, calibrated: float) -> None:
        self._calibrated = calibrated
        self._one_place = np.zeros((_RINGS, _BINS))
        self._others = np.zeros(_BINS)

    def meet(self, similarities: NDArray[np.floating], distances: FloatArray) -> None:
        """Take in how similar a view is to earlier ones.

        Args:
            similarities: (M,), -1 to 1.
            distances: (M,), how far the camera had gone between the two, as a share of the limit
                within which both show one place; NaN where nobody knows, which is nearly always a
                different place. What is known to be beyond the limit is not counted: it is nearer
                than most different places.
        """
        bins = np.clip((similarities + 1.0) * (_BINS / 2.0), 0, _BINS - 1).astype(np.int64)
        is_near = distances < 1.0
        rings = (distances[is_near] * _RINGS).astype(np.int64)
        np.add.at(self._one_place, (rings, bins[is_near]), 1.0)
        np.add.at(self._others, bins[np.isnan(distances)], 1.0)

    @property
    def min_similarity(self) -> float:
        """The threshold by what was met so far."""
        known, evidence = self._one_place_shares()
        if evidence == 0.0:
            return self._calibrated
        here = _quantile(known, _MOST_CUT)
        if self._others.any():
            here = min(here, _quantile(self._others, 1.0 - _MOST_PASSING))
        # Squared, so that what was calibrated elsewhere is soon forgotten.
        weight = evidence**2 / (evidence**2 + _PRIOR_PAIRS**2)
        return self._calibrated + weight * (here - self._calibrated)

    def fit(self, threshold: float) -> ThresholdFit:
        """Return how reliable any threshold is, by what was met so far."""
        known, _ = self._one_place_shares()
        cut = float(known[: _bin(threshold)].sum()) if known.any() else np.nan
        return ThresholdFit(
            min_similarity=threshold,
            adapted=self.min_similarity,
            one_place_pairs=int(self._one_place.sum()),
            other_pairs=int(self._others.sum()),
            cut=cut,
            passing=self._passing(known, threshold),
        )

    def _one_place_shares(self) -> tuple[FloatArray, float]:
        """Return (B,) how similar pairs of one place are, and how many pairs stand behind it.

        Pairs count equally within a ring. A ring without any adds nothing, and rings with few, or
        only some of the rings, are little evidence: a camera that stays where it is learns nothing.
        """
        counts = self._one_place.sum(axis=1)
        weights = np.divide(_RING_SHARES, counts, out=np.zeros(_RINGS), where=counts > 0.0)
        covered = float(weights @ counts)
        if covered == 0.0:
            return np.zeros(_BINS), 0.0
        independent = covered**2 / float(weights**2 @ counts)
        return weights @ self._one_place / covered, covered * independent

    def _passing(self, known: FloatArray, threshold: float) -> float:
        """Return how many pairs of different places reach the threshold, of all that do.

        Pairs as similar as the better half of those of one place show one place themselves, but for
        a few: twice as many do in all.
        """
        if not known.any() or not self._others.any():
            return np.nan
        median = _quantile(known, 0.5)
        one_place = _reaching(self._others, median) / _reaching(known, median)
        if one_place > _ONE_PLACE_FROM:
            return np.nan
        wrong = _reaching(self._others, threshold) - one_place * _reaching(known, threshold)
        return float(np.clip(wrong / (1.0 - one_place), 0.0, 1.0))


def _quantile(counts: FloatArray, share: float) -> float:
    """Return the similarity that a share of (B,) counts is below, the lower end of its bin."""
    cumulated = np.cumsum(counts)
    return 2.0 * float(np.searchsorted(cumulated, share * cumulated[-1])) / _BINS - 1.0


def _reaching(counts: FloatArray, threshold: float) -> float:
    """Return the share of (B,) counts whose bins do not lie below a similarity, NaN without any."""
    total = float(counts.sum())
    return float(counts[_bin(threshold) :].sum()) / total if total > 0.0 else np.nan


def _bin(similarity: float) -> int:
    """Return the bin whose lower end is nearest."""
    return int(np.clip(round((similarity + 1.0) * (_BINS / 2.0)), 0, _BINS))
