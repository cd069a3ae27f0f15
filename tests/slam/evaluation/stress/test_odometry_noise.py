# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.evaluation.stress.odometry_noise import drift
from slam.geometry import se3
from slam.types import Link, RelativePose

COUNT = 200
INFORMATION = np.diag([1e6, 1e6, 4e6, 1e4, 1e4, 9e4])
T_ODOM_KF = {k: se3.exp(np.array([0.0, 0.1 * k, 0.0, 0.2 * k, 0.0, 0.0])) for k in range(COUNT)}
STEPS = [Link(k - 1, k, RelativePose(np.eye(4), INFORMATION)) for k in range(1, COUNT)]
FAR = [Link(k - 3, k, RelativePose(np.eye(4), np.eye(6))) for k in range(3, COUNT)]


def moved(times, links=(*STEPS, *FAR)):
    found = drift(T_ODOM_KF, links, times, np.random.default_rng(0))
    return {k: T @ T_ODOM_KF[k] for k, T in found.items()}


@pytest.mark.parametrize("times", [1.0, 4.0])
def test_steps_are_off_by_so_many_times_what_their_links_claim(times):
    T = moved(times)
    off = [
        se3.log(se3.inverse(T_ODOM_KF[k]) @ T_ODOM_KF[k - 1] @ se3.inverse(T[k - 1]) @ T[k])
        for k in range(1, COUNT)
    ]
    squared = np.einsum("ni,ij,nj->n", off, INFORMATION, off)
    assert squared.mean() == pytest.approx(6.0 * times**2, rel=0.15)


def test_none_is_none_and_segments_that_no_link_joins_stay():
    for k, T in moved(0.0).items():
        np.testing.assert_allclose(T, T_ODOM_KF[k], atol=1e-9)
    apart = moved(4.0, [each for each in STEPS if each.query_id != 100])
    np.testing.assert_allclose(apart[100], T_ODOM_KF[100], atol=1e-12)
    assert not np.allclose(apart[99], T_ODOM_KF[99])
