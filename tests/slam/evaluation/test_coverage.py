# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.evaluation.coverage import coverage, gaps, outside_breaks
from slam.types import Trajectory


def at(stamps_s):
    stamps_s = np.asarray(stamps_s, dtype=np.float64)
    return Trajectory(stamps_s, np.tile(np.eye(4), (len(stamps_s), 1, 1)))


def test_coverage_counts_ends_and_gaps_of_the_truth():
    estimate = at([0.0, 10.0])

    def truth_at(*stamps_s):
        return at(stamps_s)

    assert coverage(estimate, truth_at(*np.arange(-8, 48) * 0.25)) == 1.0
    assert coverage(estimate, truth_at(*np.arange(8, 48) * 0.25)) == pytest.approx(0.8)
    with_gap = [*np.arange(0, 13) * 0.25, *np.arange(20, 41) * 0.25]  # nothing from 3 s to 5 s
    assert coverage(estimate, truth_at(*with_gap)) == pytest.approx(0.8)
    assert coverage(estimate, truth_at(-3.0, -2.75)) == 0.0


def test_the_breaks_between_sessions_need_no_truth():
    estimate = at([0.0, 10.0, 500.0, 530.0])
    stamps_s = [*np.arange(0, 41) * 0.25, *np.arange(2040, 2121) * 0.25]  # from 510 s on
    truth = at(stamps_s)
    assert coverage(estimate, truth, [500.0]) == pytest.approx(0.75)
    assert coverage(estimate, truth, [500.0, 600.0]) == pytest.approx(0.75)
    assert coverage(estimate, truth) < 0.1


def test_gaps_are_before_between_and_after_the_poses():
    truth = at(np.arange(0, 41) * 0.25)
    estimate = at([*np.arange(4, 17) * 0.25, *np.arange(20, 33) * 0.25, 50.0])
    np.testing.assert_allclose(gaps(estimate, truth), [[0.0, 1.0], [4.0, 5.0], [8.0, 10.0]])
    assert len(gaps(truth, truth)) == 0


def test_truth_in_the_breaks_between_sessions_is_left_out():
    truth = at(np.arange(0, 61) * 0.5)
    estimate = at([1.0, 4.0, 22.0, 30.0])  # nothing from 10 s to 20 s, where the second one was
    kept = outside_breaks(truth, estimate, [10.0, 20.0]).timestamps_s
    np.testing.assert_allclose(kept, [*np.arange(0, 9) * 0.5, *np.arange(20, 61) * 0.5])
    assert len(outside_breaks(truth, estimate, [])) == len(truth)
