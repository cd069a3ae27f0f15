# SPDX-License-Identifier: Apache-2.0
"""An odometry with larger errors than it claims."""

from collections.abc import Mapping, Sequence

import numpy as np

from slam.geometry import se3
from slam.types import FloatArray, Link


def drift(
    T_odom_kf: Mapping[int, FloatArray],
    links: Sequence[Link],
    times: float,
    rng: np.random.Generator,
) -> dict[int, FloatArray]:
    """Return by keyframe id the (4, 4) motion that takes its pose to where the noise puts it.

    The way from each keyframe to the next gets an error drawn from the covariance that the link
    between the two claims, so many times as large. Nothing is said of it: links claim what they did
    before. A keyframe that no link leads to stays where it is.
    """
    to: dict[int, Link] = {}
    for link in links:
        if link.query_id not in to or link.ref_id > to[link.query_id].ref_id:
            to[link.query_id] = link  # from the nearest before it
    moved: dict[int, FloatArray] = {}
    for k in sorted(T_odom_kf):
        noise = rng.normal(size=6)
        if (step := to.get(k)) is None:
            moved[k] = T_odom_kf[k]
            continue
        sigma = np.linalg.cholesky(np.linalg.inv(step.motion.information))
        T_ref_query = se3.inverse(T_odom_kf[step.ref_id]) @ T_odom_kf[k]
        moved[k] = moved[step.ref_id] @ T_ref_query @ se3.exp(times * sigma @ noise)
    return {k: T @ se3.inverse(T_odom_kf[k]) for k, T in moved.items()}
