# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.config import Config
from slam.mapping.landmark_map import LandmarkMap
from slam.mapping.map_adjustment import adjust_with_loops
from slam.mapping.stored_map import arrays_of_map, map_of_arrays
from slam.tracking.odometry import RgbdOdometry


@pytest.fixture(scope="module")
def the_map(frames, sequence):
    odometry = RgbdOdometry(sequence.camera, Config())
    for frame in frames[:30]:
        odometry.track(frame)
    odometry.settle()
    return odometry.map


def stored(the_map, **changed):
    T = np.array([each.T_map_cam for each in the_map.keyframes])
    empty = LandmarkMap(the_map.camera, 8, 64)
    return map_of_arrays(arrays_of_map(the_map) | changed, T, empty)


def test_a_stored_map_is_adjusted_to_loops_as_the_map_itself(the_map):
    ids = list(range(len(the_map.keyframes)))
    assert len(ids) > 3 and not the_map.landmarks.is_alive[: len(the_map.landmarks)].all()
    start = np.array([each.T_map_cam for each in the_map.keyframes])
    start[-1, 0, 3] += 0.02
    for loops in ([], [(ids[0], ids[-1])]):
        one, other = (adjust_with_loops(m, ids, start, loops) for m in (the_map, stored(the_map)))
        for a, b in zip(one.keyframes, other.keyframes, strict=True):
            np.testing.assert_array_equal(a.T_map_cam, b.T_map_cam)
            np.testing.assert_array_equal(
                one.landmarks.resolve(a.landmark_of) >= 0,
                other.landmarks.resolve(b.landmark_of) >= 0,
            )


@pytest.mark.parametrize("name", ["feature_count", "feature_depth_m", "landmark_octaves"])
def test_arrays_that_do_not_fit_each_other_are_refused(the_map, name):
    with pytest.raises(ValueError):
        stored(the_map, **{name: arrays_of_map(the_map)[name][:-1]})
    with pytest.raises(ValueError, match="landmarks"):
        stored(the_map, feature_landmark=arrays_of_map(the_map)["feature_landmark"] + 10**6)
