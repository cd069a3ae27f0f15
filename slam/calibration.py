# SPDX-License-Identifier: Apache-2.0
"""Where the recognizer's threshold comes from, beside what the recognizer saw in a run."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placerec.certificate import Certificate


@dataclass(frozen=True)
class Calibration:
    """What the recognizer was calibrated on, and how similar it found what it met.

    Attributes:
        certificate: the recognizer's own.
        live_similarities: (M,) float32, similarities of all pairs of keyframes that could be loops.
    """

    certificate: Certificate
    live_similarities: NDArray[np.float32]

    @property
    def warnings(self) -> tuple[str, ...]:
        """One sentence where the two are too unlike for the threshold to be trusted, else none."""
        warning = self.certificate.outside_calibrated_range(self.live_similarities)
        return () if warning is None else (warning,)

    @property
    def passing(self) -> float:
        """Share of the live pairs that reach the calibrated `min_similarity`, NaN without pairs."""
        return self._share(self.live_similarities >= self.certificate.min_similarity)

    @property
    def outside(self) -> float:
        """Share of the live pairs outside the calibrated range, NaN without pairs."""
        low, high = self.certificate.calibrated_range
        return self._share((self.live_similarities < low) | (self.live_similarities > high))

    def _share(self, chosen: NDArray[np.bool_]) -> float:
        return float(chosen.mean()) if chosen.size else np.nan
