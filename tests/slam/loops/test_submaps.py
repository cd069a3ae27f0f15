# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.geometry import se3
from slam.loops.submaps import Loop, Submap, align_maps, joined
from slam.types import Rejection, RejectionReason, RelativePose

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


def two_maps(points_m, later=(-0.5, 0.5), seed=0):
    """Return where two maps, each numbered from 0, have their keyframes, and loops between them."""
    T_a_kf, T_a_later = ROW, cameras(later)
    of_both = loops_between(T_a_kf, T_a_later, points_m, np.random.default_rng(seed))
    loops = [replace(each, query_id=each.query_id - len(ROW)) for each in of_both]
    T_b_a = se3.inverse(T_EARLIER_LATER)
    T_b_kf = {k: T_b_a @ T for k, T in enumerate(T_a_later)}
    return dict(enumerate(T_a_kf)), T_b_kf, loops


TWO_PICTURES = np.concatenate([wall((-1, 0)), wall((1, 0))])


def moved(loop, tangent):
    motion = replace(loop.motion, T_ref_query=loop.motion.T_ref_query @ se3.exp(np.array(tangent)))
    return replace(loop, motion=motion)


def test_two_maps_lie_where_loops_at_two_places_say():
    T_a_kf, T_b_kf, loops = two_maps(TWO_PICTURES)
    np.testing.assert_allclose(align_maps(T_a_kf, T_b_kf, loops), T_EARLIER_LATER, atol=1e-9)


def test_the_mean_counts_and_a_false_loop_has_no_say():
    T_a_kf, T_b_kf, loops = two_maps(TWO_PICTURES)
    ways = np.random.default_rng(1).normal(size=(len(loops), 6)) * 0.005
    noisy = [moved(loop, way) for loop, way in zip(loops, ways - ways.mean(axis=0), strict=True)]
    false = moved(loops[0], [0.0, 0.3, 0.0, 1.0, 0.0, 0.0])
    T_a_b = align_maps(T_a_kf, T_b_kf, [false, *noisy])
    # Each single one is off by some millimetres.
    np.testing.assert_allclose(T_a_b[:3, 3], T_EARLIER_LATER[:3, 3], atol=0.02)
    np.testing.assert_allclose(T_a_b, align_maps(T_a_kf, T_b_kf, noisy), atol=1e-12)


def test_one_place_however_often_seen_is_not_enough_to_align_maps():
    T_a_kf, T_b_kf, loops = two_maps(wall((0, 0)), later=(-0.3, 0.0, 0.3))
    assert len(loops) > 2
    refused = align_maps(T_a_kf, T_b_kf, loops)
    assert refused == Rejection(RejectionReason.UNJOINED, 1, 2)
    assert align_maps(T_a_kf, T_b_kf, []) == Rejection(RejectionReason.UNJOINED, 0, 2)


def test_two_loops_that_contradict_each_other_align_nothing():
    T_a_kf, T_b_kf, loops = two_maps(TWO_PICTURES)
    apart = [next(each for each in loops if each.query_id == k) for k in (0, 1)]
    apart[1] = next(each for each in loops if each.query_id == 1 and each.ref_id == 3)
    assert not isinstance(align_maps(T_a_kf, T_b_kf, apart), Rejection)
    contradicting = [apart[0], moved(apart[1], [0.0, 0.0, 0.0, 0.15, 0.0, 0.0])]
    assert isinstance(align_maps(T_a_kf, T_b_kf, contradicting), Rejection)


def test_loops_of_keyframes_without_a_place_are_left_out():
    T_a_kf, T_b_kf, loops = two_maps(TWO_PICTURES)
    assert isinstance(align_maps({0: T_a_kf[0]}, T_b_kf, loops), Rejection)
    assert isinstance(align_maps(T_a_kf, {}, loops), Rejection)
