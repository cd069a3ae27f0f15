# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np

from slam.geometry import se3
from slam.loops.candidates.known_distances import KnownDistances
from slam.types import Keyframe


def at(x_m, segment=0):
    """Return a keyframe at a place along x, which shows nothing."""
    T = se3.from_rotation_translation(np.eye(3), [x_m, 0.0, 0.0])
    return replace(Keyframe(0, 0.0, T, None, None), segment=segment)


def test_a_distance_is_a_share_of_one_place_and_not_of_the_way_gone():
    known = KnownDistances()
    assert known.add(at(0.0)).shape == (0,)
    known.add(at(0.6))
    np.testing.assert_allclose(known.add(at(0.0)), [0.0, 1.0])  # there and back


def test_beyond_so_much_of_the_way_or_in_another_segment_nothing_is_known():
    known = KnownDistances()
    known.add(at(0.0))
    known.add(at(2.0))
    np.testing.assert_allclose(known.add(at(0.0)), [np.nan, 2.0 / 0.6])  # 4 m of way
    assert np.isnan(known.add(at(0.0, segment=1))).all()
