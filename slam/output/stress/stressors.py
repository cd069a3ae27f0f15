# SPDX-License-Identifier: Apache-2.0
"""What is made worse, and the levels that each is tried at."""

from collections.abc import Mapping
from dataclasses import dataclass

from slam.evaluation.stress.false_loops import CLUSTERS, SCATTERED
from slam.types import SlamError

CLEAN = "clean"
ODOMETRY_NOISE = "odometry-noise"


@dataclass(frozen=True)
class Stressor:
    """One thing that is made worse.

    Attributes:
        levels: rising; 0 is the clean run.
        unit: what a level says.
    """

    levels: tuple[float, ...]
    unit: str


STRESSORS: Mapping[str, Stressor] = {
    "dropped-frames": Stressor((0.2, 0.4, 0.6, 0.8), "share of the frames"),
    "missing-depth": Stressor((0.3, 0.6, 0.8, 0.95), "share of the depth image"),
    "blur": Stressor((0.005, 0.01, 0.02, 0.04), "length of the smear, share of the width"),
    "darkness": Stressor((0.5, 0.75, 0.9, 0.97), "share of the light that is missing"),
    "moving-object": Stressor((0.05, 0.1, 0.25, 0.5), "share of the image that it covers"),
    SCATTERED: Stressor((0.1, 0.3, 0.5, 0.8), "share of all loops"),
    CLUSTERS: Stressor((0.1, 0.3, 0.5, 0.8), "share of all loops"),
    ODOMETRY_NOISE: Stressor((1.0, 2.0, 4.0, 8.0), "times the errors that it claims"),
}
"""By name, in the order in which they are tried."""


def chosen(names: str | None) -> list[str]:
    """Return the stressors of a list such as `blur,darkness`, all where there is none.

    Raises:
        SlamError: there is no such stressor.
    """
    if names is None:
        return list(STRESSORS)
    wanted = [each.strip() for each in names.split(",")]
    for each in wanted:
        if each not in STRESSORS:
            raise SlamError(f"--only {each!r}: there is {', '.join(STRESSORS)}")
    return [each for each in STRESSORS if each in wanted]
