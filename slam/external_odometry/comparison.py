# SPDX-License-Identifier: Apache-2.0
"""What images measured between keyframes beside what an odometry from elsewhere says of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from slam.geometry import se3
from slam.types import FloatArray, IntArray, Link

# Variance, rad^2 and m^2, of a pose at an image's time between two that came, however good those
# are: a steady motion is assumed.
_BETWEEN = 5e-4**2 * np.eye(6)


@dataclass(frozen=True)
class GivenKeyframe:
    """Where an odometry from elsewhere has a keyframe.

    Attributes:
        T_given_cam: (4, 4), in the odometry's frame.
        covariance: (6, 6) of its motion since the keyframe before, as a tangent on the right, where
            it tells it: then that is believed.
        is_new: whether it began anew since the keyframe before, as in another session.
        is_between: whether no pose came of that time, but one before and one after it.
    """

    T_given_cam: FloatArray
    covariance: FloatArray | None = None
    is_new: bool = False
    is_between: bool = False


class GivenPath:
    """Where the odometry has the keyframes, and how far it is from one to the other."""

    def __init__(
        self,
        given: Mapping[int, GivenKeyframe],
        stamps_s: Mapping[int, float],
        doubted: Sequence[int] = (),
    ) -> None:
        ids = sorted(given)
        self.ids: IntArray = np.array(ids, np.int64)
        self._row = {k: row for row, k in enumerate(ids)}
        self.T = np.array([given[k].T_given_cam for k in ids]).reshape(-1, 4, 4)
        self.is_between = np.array([given[k].is_between for k in ids], np.bool_)
        self._piece = np.cumsum([given[k].is_new or k in doubted for k in ids])
        step = se3.inverse(self.T[:-1]) @ self.T[1:]
        seconds = np.diff([stamps_s[k] for k in ids])
        sizes = np.column_stack([se3.translation_norm(step), se3.rotation_angle(step), seconds])
        self._way = np.concatenate([np.zeros((1, 3)), np.cumsum(sizes.reshape(-1, 3), axis=0)])

    def has(self, motion: Link) -> bool:
        """Whether the odometry went from one of the keyframes to the other."""
        ref, query = self._row.get(motion.ref_id), self._row.get(motion.query_id)
        if ref is None or query is None:
            return False
        return bool(self._piece[ref] == self._piece[query])

    def but_of_first(self, motions: Sequence[Link]) -> list[Link]:
        """Return the motions that do not begin at the first keyframe."""
        return [each for each in motions if each.ref_id != self.ids[0]]

    def rows(self, ids: IntArray) -> IntArray:
        """Return the rows of keyframe ids."""
        return np.searchsorted(self.ids, ids)

    def steps(self) -> list[tuple[int, int]]:
        """Return consecutive keyframes that the odometry went between."""
        is_step = np.diff(self._piece) == 0
        return [
            (int(a), int(b)) for a, b in np.column_stack([self.ids[:-1], self.ids[1:]])[is_step]
        ]

    def extents(self, pairs: IntArray) -> FloatArray:
        """Return (N, 3), metres, radians and seconds on the way between (N, 2) keyframes."""
        rows = self.rows(pairs)
        return np.asarray(np.abs(self._way[rows[:, 1]] - self._way[rows[:, 0]]))


@dataclass(frozen=True)
class Comparison:
    """N motions of the images, and how far those of the odometry are off.

    Attributes:
        errors: (N, 6) tangents, rad and m.
        covariances: (N, 6, 6), what the images claim.
        extents: (N, 3) metres, radians and seconds on the way.
        lags: (N,) keyframes on the way.
        images: (N,) the later keyframe's row, whose image's noise all of its motions share.
        between: (N,) at how many ends the odometry's pose is between two that came.
    """

    errors: FloatArray
    covariances: FloatArray
    extents: FloatArray
    lags: IntArray
    images: IntArray
    between: IntArray

    @staticmethod
    def of(motions: Sequence[Link], path: GivenPath) -> "Comparison":
        """Compare motions between keyframes that the odometry went between."""
        pairs = np.array([(each.ref_id, each.query_id) for each in motions])
        rows = path.rows(pairs)
        measured = np.array([each.motion.T_ref_query for each in motions])
        given = se3.inverse(path.T[rows[:, 0]]) @ path.T[rows[:, 1]]
        return Comparison(
            se3.log(se3.inverse(measured) @ given),
            np.linalg.inv(np.array([each.motion.information for each in motions])),
            path.extents(pairs),
            np.abs(rows[:, 1] - rows[:, 0]),
            rows.max(axis=1),
            path.is_between[rows].sum(axis=1),
        )

    def squared(self, rotation: FloatArray, translation: FloatArray) -> FloatArray:
        """Return (N,) squared errors in units of the images' noise and the odometry's, added."""
        more = np.repeat(self.extents @ np.column_stack([rotation, translation]), 3, axis=1)
        total = self.covariances + more[:, :, None] * np.eye(6)
        weights = np.linalg.inv(total + self.between[:, None, None] * _BETWEEN)
        return np.asarray(np.einsum("ni,nij,nj->n", self.errors, weights, self.errors))
