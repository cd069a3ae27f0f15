# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.geometry import se3
from slam.loops.submaps import Loop, Submap, joined
from slam.types import RelativePose

INFORMATION = np.diag([1e5] * 3 + [1e4] * 3)
T_EARLIER_LATER = se3.exp(np.array([0.2, 1.0, -0.3, 4.0, 1.0, -2.0]))
FIELD_OF_VIEW = (0.6, 0.45)  # tangents of half of it
GRID = np.stack(np.meshgrid(np.linspace(-0.5, 0.5, 15), np.linspace(-0.5, 0.5, 15)), -1)
POSTER_M = np.column_stack([GRID.reshape(-1, 2) * (0.9, 0.6), np.zeros(225)])


def wall(centre_m, size_m=1.0):
    """Return (225, 3) points on a wall two metres in front of the origin."""
    return size_m * POSTER_M + [*centre_m, 2.0]


def cameras(xs_m, forward_m=0.0, turned_deg=0.0):
    """Return cameras in a row before the wall."""
    turned = [0.0, np.radians(turned_deg), 0.0, 0.0, 0.0, 0.0]
    places = [se3.from_rotation_translation(np.eye(3), np.array([x, 0.0, forward_m])) for x in xs_m]
    return [T @ se3.exp(np.array(turned)) for T in places]


def loops_between(T_earlier_kf, T_later_kf, points_m, rng, most=4):
    """Return the loops of all later cameras with all earlier ones that see enough of the points.

    All poses are in the earlier submap's frame. A loop matches some of the points that both see.
    """
    loops = []
    for query_id, T_query in enumerate(T_later_kf, start=len(T_earlier_kf)):
        for ref_id, T_ref in list(enumerate(T_earlier_kf))[:most]:
            both = points_m[in_view(T_ref, points_m) & in_view(T_query, points_m)]
            both = both[rng.random(len(both)) < 0.4]
            if len(both) >= 25:
                motion = RelativePose(se3.inverse(T_ref) @ T_query, INFORMATION)
                seen_m = se3.transform(se3.inverse(T_ref), both)
                loops.append(Loop.of(ref_id, query_id, motion, seen_m))
    return loops


def in_view(T_earlier_cam, points_m):
    x, y, z = se3.transform(se3.inverse(T_earlier_cam), points_m).T
    return (z > 0.2) & (abs(x) < FIELD_OF_VIEW[0] * z) & (abs(y) < FIELD_OF_VIEW[1] * z)


def submaps(T_earlier_kf, T_later_kf):
    T_later_earlier = se3.inverse(T_EARLIER_LATER)
    first = len(T_earlier_kf)
    later = {first + i: T_later_earlier @ T for i, T in enumerate(T_later_kf)}
    return [Submap(dict(enumerate(T_earlier_kf)), []), Submap(later, [])]


def are_joined(T_earlier_kf, T_later_kf, points_m):
    rng = np.random.default_rng(0)
    loops = loops_between(T_earlier_kf, T_later_kf, points_m, rng)
    assert len(loops) > 2
    parts = submaps(T_earlier_kf, T_later_kf)
    return len(joined(parts, loops)) == 1


ROW = cameras([-0.6, -0.2, 0.2, 0.6])


def test_two_pictures_on_one_wall_join():
    assert are_joined(ROW, cameras([-0.5, 0.5]), np.concatenate([wall((-1, 0)), wall((1, 0))]))


@pytest.mark.parametrize(
    "later",
    [
        cameras([-0.3, 0.0, 0.3]),
        cameras([-1.1, 1.1]),  # a part of the poster is out of view
        cameras([-0.2, 0.2], forward_m=0.8),
        [*cameras([0.1], turned_deg=15.0), *cameras([-0.1], turned_deg=-15.0)],
    ],
)
def test_a_poster_and_its_twin_elsewhere_do_not_however_often_and_from_wherever_seen(later):
    assert not are_joined(ROW, later, wall((0, 0)))


def test_a_view_of_two_places_at_once_is_one_place_with_each_of_its_loops():
    both = np.concatenate([wall((-1, 0), 0.5), wall((1, 0), 0.5)])
    apart = [*cameras([-1.2]), *cameras([1.2])]
    (query,) = cameras([0.0])
    rng = np.random.default_rng(0)
    loops = loops_between(apart, [query], both, rng)
    assert [(loop.ref_id, loop.query_id) for loop in loops] == [(0, 2), (1, 2)]
    assert len(joined(submaps(apart, [query]), loops)) == 2
    loops = loops_between(apart, [query, query], both, rng)
    assert len(joined(submaps(apart, [query, query]), loops)) == 1


def test_a_loop_the_other_way_round_is_the_same_loop():
    T_ref_query = se3.exp(np.array([0.3, -0.2, 0.1, 0.5, 0.4, -0.3]))
    seen_m = wall((0.3, 0.1))
    loop = Loop.of(3, 7, RelativePose(T_ref_query, INFORMATION), seen_m)
    seen_by_query_m = se3.transform(se3.inverse(T_ref_query), seen_m)
    again = Loop.of(7, 3, RelativePose(se3.inverse(T_ref_query), INFORMATION), seen_by_query_m)
    turned = loop.reversed
    assert (turned.ref_id, turned.query_id) == (7, 3)
    np.testing.assert_allclose(turned.motion.T_ref_query, again.motion.T_ref_query, atol=1e-9)
    np.testing.assert_allclose(turned.centre_ref_m, again.centre_ref_m, atol=1e-9)
    assert turned.radius_m == pytest.approx(again.radius_m) == pytest.approx(loop.radius_m)
