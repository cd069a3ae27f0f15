# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from placerec.datasets.labelled_images import PairTruth
from placerec.errors import RecognizerError
from placerec.training.image_sets import SetRules, build_image_sets, one_of_each, sample_scenes


def _at(*angles_rad):
    """Return features on the unit circle; neighbours 0.3 rad apart are 0.09 apart squared."""
    return np.array([[np.cos(a), np.sin(a)] for a in angles_rad], np.float32)


def _by_labels(places):
    same = np.equal.outer(places, places)
    return PairTruth(same, ~same, np.zeros_like(same))


def _by_position(positions_m, limit=0.6, beyond=1.0):
    distance = np.abs(np.subtract.outer(positions_m, positions_m))
    apart = distance >= limit
    return PairTruth(~apart, apart, apart & (distance < beyond))


def _rng(seed=0):
    return np.random.default_rng(seed)


def _scattered(count, places, dimension, seed):
    rng = np.random.default_rng(seed)
    features = rng.normal(size=(count, dimension))
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    labels = np.concatenate([np.arange(places), rng.integers(0, places, count - places)])
    return features.astype(np.float32), rng.permutation(labels)


# Six places, far apart on the circle, each with two images close together.
FAR_PLACES = np.repeat(np.arange(6), 2)
FAR = _at(*(a + d for a in np.arange(6) * (np.pi / 3) for d in (0.0, 0.01)))


def test_nothing_to_learn_makes_no_set():
    sets = build_image_sets(FAR, _by_labels(FAR_PLACES), _rng())
    assert len(sets) == 0
    assert sets.positives.shape == (0, 4)
    assert sets.negatives.shape == (0, 4)


def test_spread_place_without_confusion_takes_negatives_anywhere():
    # Lines 12-13, second half: X_tem^n is empty, X_tem^p is not.
    places = np.array([0, 0, 1, 2, 3, 4, 5])
    features = _at(-0.6, 0.6, np.pi, np.pi, np.pi, np.pi, np.pi)
    sets = build_image_sets(features, _by_labels(places), _rng(), anchors=np.array([0]))
    assert len(sets) == 1
    assert set(sets.positives[0]) == {0, 1}
    assert sets.positives[0][0] == 1  # what was mined comes first; the anchor only as a copy
    negatives = sets.negatives[0]
    assert len(set(places[negatives])) == 4
    assert 0 not in places[negatives]
    seen = {
        n
        for s in range(50)
        for n in build_image_sets(features, _by_labels(places), _rng(s)).negatives[0]
    }
    assert seen == {2, 3, 4, 5, 6}


def test_confused_place_that_is_tight_copies_its_own_images():
    # Line 18, second half: X_tem^p is empty, X_tem^n is not. One image is confused, four needed.
    places = np.array([0, 0, 1, 2, 3, 4, 5])
    features = _at(0.0, 0.01, 0.02, np.pi, np.pi, np.pi, np.pi)
    sets = build_image_sets(features, _by_labels(places), _rng(), anchors=np.array([0]))
    assert set(sets.positives[0]) == {0, 1}
    assert len(sets.positives[0]) == 4
    assert sets.negatives[0][0] == 2
    assert len(set(places[sets.negatives[0]]) - {0}) == 4


def test_too_many_positives_are_drawn_from_at_random():
    places = np.array([0] * 8 + [1, 2, 3, 4])
    features = _at(*np.linspace(-1.5, 1.5, 8), np.pi, np.pi, np.pi, np.pi)
    # All eight but none within sqrt(0.1) of the centre: which four is up to the seed.
    drawn = [
        tuple(
            build_image_sets(
                features, _by_labels(places), _rng(s), anchors=np.array([7])
            ).positives[0]
        )
        for s in range(30)
    ]
    assert all(len(set(four)) == 4 and 7 not in four for four in drawn)
    assert len(set(drawn)) > 10


def test_too_few_positives_are_topped_up_from_the_same_place():
    places = np.array([0, 0, 0, 0, 0, 1, 2, 3, 4])
    features = _at(0.0, 0.0, 0.0, 0.0, 1.0, np.pi, np.pi, np.pi, np.pi)
    sets = build_image_sets(features, _by_labels(places), _rng(), anchors=np.array([0]))
    assert sets.positives[0][0] == 4  # the only one beyond gamma
    assert set(sets.positives[0]) <= {0, 1, 2, 3, 4}
    assert len(set(sets.positives[0])) == 4  # no copy as long as there are other images


def test_too_many_confused_places_are_drawn_from_at_random():
    places = np.repeat(np.arange(9), 2)
    features = _at(*np.linspace(0.0, 0.1, 18))
    drawn = [
        tuple(
            build_image_sets(
                features, _by_labels(places), _rng(s), anchors=np.array([0])
            ).negatives[0]
        )
        for s in range(30)
    ]
    assert all(len(set(places[list(four)]) - {0}) == 4 for four in drawn)
    assert len(set(drawn)) > 20


def test_place_with_one_image_that_looks_like_another_is_its_own_copies():
    places = np.arange(6)
    features = _at(0.0, 0.1, *np.full(4, np.pi))
    sets = build_image_sets(features, _by_labels(places), _rng(), anchors=np.array([0]))
    np.testing.assert_array_equal(sets.positives, [[0, 0, 0, 0]])
    assert 1 in sets.negatives[0]


def test_gammas_are_strict_bounds_of_squared_distances_to_the_centre():
    places = np.array([0, 0, 1, 2, 3])
    # The centre is (1, 0): both positives are 0.25 from it, the negatives 1, 4 and 9 / 4.
    features = np.array([[1, 0.5], [1, -0.5], [1, 1], [1, 2], [1, 1.5]], np.float32)
    rules = SetRules(gamma=0.25, gamma_prime=1.0, positives=1, negatives=2)
    assert len(build_image_sets(features, _by_labels(places), _rng(), rules, np.array([0]))) == 0
    looser = SetRules(gamma=0.24, gamma_prime=1.0, positives=1, negatives=2)
    sets = build_image_sets(features, _by_labels(places), _rng(), looser, np.array([0]))
    np.testing.assert_array_equal(sets.positives, [[1]])
    looser = SetRules(gamma=0.25, gamma_prime=1.01, positives=1, negatives=2)
    sets = build_image_sets(features, _by_labels(places), _rng(), looser, np.array([0]))
    assert sets.negatives[0][0] == 2


def _literal(features, places, rules):
    """Return X_tem^p and X_tem^n of every image by the paper's two loops."""
    n = len(places)
    for i in range(n):
        same = [j for j in range(n) if places[j] == places[i]]
        centre = np.mean(features[same].astype(np.float64), axis=0)
        distances = [float(((features[j] - centre) ** 2).sum()) for j in range(n)]
        rest = [j for j in range(n) if j != i]
        yield (
            {j for j in rest if places[j] == places[i] and distances[j] > rules.gamma},
            {j for j in rest if places[j] != places[i] and distances[j] < rules.gamma_prime},
        )


@settings(max_examples=40, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(8, 40),
    dimension=st.integers(2, 8),
    gamma=st.floats(0.0, 1.0),
    gamma_prime=st.floats(0.0, 1.5),
)
def test_sets_are_those_of_the_paper_written_out(seed, count, dimension, gamma, gamma_prime):
    features, places = _scattered(count, 6, dimension, seed)
    rules = SetRules(gamma, gamma_prime)
    sets = build_image_sets(features, _by_labels(places), _rng(seed), rules)
    mined = list(_literal(features, places, rules))
    expected = [i for i, (near, far) in enumerate(mined) if near or far]
    assert len(sets) == len(expected)
    for i, positives, negatives in zip(expected, sets.positives, sets.negatives, strict=True):
        spread, confused = mined[i]
        assert set(places[positives]) == {places[i]}
        assert len(set(places[negatives]) - {places[i]}) == 4
        assert len(spread & set(positives)) >= min(4, len(spread))
        assert len(confused & set(negatives)) >= min(4, len({places[j] for j in confused}))


def test_same_seed_same_sets_and_labels_need_no_order():
    features, places = _scattered(60, 8, 4, seed=5)
    first = build_image_sets(features, _by_labels(places), _rng(1))
    again = build_image_sets(features, _by_labels(places * 10 - 3), _rng(1))
    other = build_image_sets(features, _by_labels(places), _rng(2))
    np.testing.assert_array_equal(first.negatives, again.negatives)
    np.testing.assert_array_equal(first.positives, again.positives)
    assert (first.negatives != other.negatives).any()


def test_anchors_pick_the_rows_in_their_order():
    features, places = _scattered(300, 300, 3, seed=6)
    anchors = np.array([250, 3, 77, 3])
    sets = build_image_sets(features, _by_labels(places), _rng(), anchors=anchors)
    np.testing.assert_array_equal(sets.positives[:, 0], anchors)


def test_features_that_are_not_finite_are_refused():
    features = FAR.copy()
    features[3] = np.nan
    with pytest.raises(RecognizerError, match="1 of 12 images"):
        build_image_sets(features, _by_labels(FAR_PLACES), _rng())
    with pytest.raises(RecognizerError, match="12 features, and a truth of 11"):
        build_image_sets(FAR, _by_labels(FAR_PLACES[:11]), _rng())


def test_one_image_of_each_place_is_drawn():
    places = np.array([7] * 10 + [3] + [5] * 2 + [9] * 30)
    places = _rng(1).permutation(places)
    images = one_of_each(places, _rng(2))
    np.testing.assert_array_equal(images, np.unique(images))
    assert sorted(places[images]) == [3, 5, 7, 9]
    assert set(images) != set(one_of_each(places, _rng(3)))


def test_places_that_may_be_one_are_no_negatives():
    # Place 1 is confused with place 0, but one of its images may show place 0.
    places = np.array([0, 0, 1, 1, 2, 3, 4, 5])
    features = _at(0.0, 0.01, 0.02, 0.03, np.pi, np.pi, np.pi, np.pi)
    truth = _by_labels(places)
    truth.apart[0, 2] = truth.apart[2, 0] = False
    anchors = np.array([0])
    plain = build_image_sets(features, _by_labels(places), _rng(), anchors=anchors)
    kept = build_image_sets(features, truth, _rng(), anchors=anchors)
    assert set(plain.negatives[0]) & {2, 3}
    assert kept.negatives[0][0] == 3  # still confused, and surely of another place
    assert 2 not in kept.negatives[0]


def test_place_hemmed_in_by_what_may_be_the_same_makes_no_set():
    places = np.array([0, 0, 1, 2, 3, 4])
    features = _at(0.0, 0.9, 0.02, np.pi, np.pi, np.pi)
    truth = _by_labels(places)
    truth.apart[0, 2] = truth.apart[2, 0] = False
    assert len(build_image_sets(features, truth, _rng(), anchors=np.array([0]))) == 0


def test_negatives_that_may_be_one_place_stand_in_one_set_only_where_there_are_no_others():
    rng = _rng()
    features, _ = _scattered(40, 20, 8, seed=3)
    places = np.repeat(np.arange(20), 2)
    rooms = places // 3
    truth = _by_labels(places)
    truth.apart[rooms[:, None] == rooms] = False
    for rules in (SetRules(), SetRules(gamma_prime=4.0)):  # filled up at random, and all confused
        sets = build_image_sets(features, truth, rng, rules)
        assert len(sets) > 30
        assert all(len(set(rooms[row])) == 4 for row in sets.negatives)

    def of_the_first(count):
        return PairTruth(*(m[:count, :count] for m in (truth.same, truth.apart, truth.beyond)))

    # Three others of the other room alone: four cannot be had.
    assert len(build_image_sets(features[:12], of_the_first(12), rng)) == 0
    some = build_image_sets(features[:14], of_the_first(14), rng)
    assert len(some) > 0
    assert all(len(set(places[row])) == 4 for row in some.negatives)


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(20, 60))
def test_a_set_says_only_what_poses_say(seed, count):
    rng = _rng(seed)
    positions_m = rng.uniform(0.0, 6.0, count)
    features, _ = _scattered(count, count, 4, seed)
    truth = _by_position(positions_m)
    anchors = np.arange(count)
    sets = build_image_sets(features, truth, rng, SetRules(gamma_prime=4.0), anchors)
    assert len(sets) > 0
    for positives, negatives in zip(sets.positives, sets.negatives, strict=True):
        assert truth.same[:, positives].all(axis=1).any()  # one anchor has all of them around it
        assert truth.apart[np.ix_(positives, negatives)].all()
        assert truth.apart[np.ix_(negatives, negatives)].sum() == 12  # each from three others


def test_positives_reach_as_far_as_a_place_does_and_negatives_begin_just_beyond():
    positions_m = np.concatenate([np.linspace(-0.55, 0.55, 23), [0.7, -0.7, 5, 6, 7, 8, 9, 10]])
    anchor = np.array([11])
    assert positions_m[11] == 0.0
    features, _ = _scattered(len(positions_m), len(positions_m), 8, seed=1)
    truth, rules = _by_position(positions_m), SetRules(gamma_prime=4.0)
    reached, borders = [], 0
    for seed in range(60):
        sets = build_image_sets(features, truth, _rng(seed), rules, anchor)
        reached.extend(np.abs(positions_m[sets.positives[0]]))
        borders += np.isin([23, 24], sets.negatives[0]).sum()
        assert not set(sets.negatives[0][2:]) & {23, 24}  # at most half of them are neighbours
    assert max(reached) == pytest.approx(0.55)
    assert borders == 60  # one in each; with both, only its middle would be left of the place


def test_scenes_are_drawn_with_all_images_of_some_of_their_places():
    scenes = np.repeat([0, 1, 2], [12, 12, 24])
    places = np.repeat(np.arange(24), 2)
    one = np.zeros_like(scenes)
    drawn = [sample_scenes(scenes, places, one, 2, 3, _rng(seed)) for seed in range(60)]
    for images in drawn:
        assert len(np.unique(scenes[images])) == 2
        assert [len(images[places[images] == p]) for p in np.unique(places[images])] == [2] * 6
        assert (np.diff(images) > 0).all()
    visits = np.bincount([s for images in drawn for s in np.unique(scenes[images])])
    assert visits[2] > visits[0]  # twice the places: visited more often
    assert visits[:2].min() > 10


def test_all_scenes_and_places_where_there_are_no_more():
    scenes, places = np.array([0, 0, 1, 1]), np.array([0, 0, 1, 2])
    assert sample_scenes(scenes, places, scenes, 9, 9, _rng()).tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(("count", "share_of_small"), [(1, 0.5), (3, 0.45)])
def test_collections_have_the_same_chance_however_large_they_are(count, share_of_small):
    scenes = np.arange(20)
    collections = np.where(scenes < 18, 5, 3)  # eighteen scenes of one kind, two of another
    drawn = [
        scenes[sample_scenes(scenes, scenes, collections, count, 1, _rng(seed))]
        for seed in range(400)
    ]
    visits = np.bincount(np.concatenate(drawn), minlength=20) / (400.0 * count)
    assert visits[18:].sum() == pytest.approx(share_of_small, abs=0.07)
    assert visits[18:].min() > 0.15 and visits[:18].min() > 0
