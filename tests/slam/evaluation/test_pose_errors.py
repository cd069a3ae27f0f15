# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.evaluation.pose_errors import (
    Delta,
    pairs_along,
    pairs_in_time,
    pairs_of_frames,
    read_deltas,
    relative_errors,
    statistics,
)
from slam.geometry import se3
from slam.types import SlamError


def along(*way_m):
    return np.array([[x, 0.0, 0.0] for x in way_m])


def listed(pairs):
    return [(int(a), int(b)) for a, b in zip(*pairs, strict=True)]


def test_deltas_are_read_as_they_are_typed():
    assert read_deltas("1m, 0.5s,10f,1m") == (Delta(1.0, "m"), Delta(0.5, "s"), Delta(10.0, "f"))
    assert [str(each) for each in read_deltas("100m,.5s")] == ["100 m", "0.5 s"]


@pytest.mark.parametrize("text", ["", "1", "m", "-1m", "0m", "1.5f", "1m;2m", "1e3m", "9999999m"])
def test_what_is_no_delta_is_refused(text):
    with pytest.raises(SlamError, match="such as 1m,5m,1s,10f"):
        read_deltas(text)


def test_pairs_follow_each_other_along_the_way():
    positions_m = along(0.0, 0.6, 1.2, 1.3, 2.0, 2.4, 2.9)
    assert listed(pairs_along(positions_m, 1.0, all_pairs=False)) == [(0, 2), (2, 5)]
    assert listed(pairs_along(positions_m, 5.0, all_pairs=False)) == []
    assert listed(pairs_along(positions_m[:1], 1.0, all_pairs=False)) == []


def test_all_pairs_meet_the_distance_best_and_to_a_tenth():
    positions_m = along(0.0, 0.6, 1.04, 1.04, 1.1, 1.65, 3.0)
    assert listed(pairs_along(positions_m, 1.0, all_pairs=True)) == [(0, 2), (1, 5)]
    still = pairs_along(along(0.0, 0.0, 0.0), 1.0, all_pairs=True)
    assert listed(still) == listed(pairs_along(positions_m[:1], 1.0, all_pairs=True)) == []


def test_pairs_of_frames_and_of_time():
    assert listed(pairs_of_frames(7, 3, all_pairs=False)) == [(0, 3), (3, 6)]
    assert listed(pairs_of_frames(5, 3, all_pairs=True)) == [(0, 3), (1, 4)]
    assert listed(pairs_of_frames(3, 3, all_pairs=True)) == []
    stamps_s = np.array([0.0, 0.99, 1.5, 2.04])
    assert listed(pairs_in_time(stamps_s, 1.0, 0.02)) == [(0, 1)]
    assert listed(pairs_in_time(stamps_s, 1.0, 0.051)) == [(0, 1), (1, 3)]


def test_relative_errors_do_not_depend_on_the_frame():
    rng = np.random.default_rng(3)
    T_truth = se3.exp(rng.normal(0.0, 1.0, (4, 6)))
    T = se3.exp(rng.normal(0.0, 1.0, 6)) @ T_truth
    T[3] = T[3] @ se3.exp(np.array([0.0, 0.0, np.deg2rad(9.0), 0.0, 0.0, 0.0]))
    T[3, :3, 3] += 0.3 * T[3, :3, 2]
    errors_m, errors_deg = relative_errors(T, T_truth, pairs_of_frames(4, 1, all_pairs=True))
    np.testing.assert_allclose(errors_m, [0.0, 0.0, 0.3], atol=1e-12)
    np.testing.assert_allclose(errors_deg, [0.0, 0.0, 9.0], atol=1e-6)


def test_statistics_are_those_of_the_field_and_unknown_of_nothing():
    found = statistics(np.array([1.0, 2.0, 6.0]))
    assert found.rmse == pytest.approx(np.sqrt(41.0 / 3.0))
    assert found[1:] == pytest.approx((3.0, 2.0, np.sqrt(14.0 / 3.0), 1.0, 6.0))
    assert np.isnan(statistics(np.zeros(0))).all()
