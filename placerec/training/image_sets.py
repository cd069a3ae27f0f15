# SPDX-License-Identifier: Apache-2.0
"""Multi-constraint image sets: what a network still confuses, made ready to learn from.

The names and line numbers are those of the paper's Algorithm 1. Images are named by their index.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placerec.datasets.labelled_images import PairTruth
from placerec.errors import RecognizerError

GAMMA_PRIME = 0.4
_BLOCK = 256

Indices = NDArray[np.int64]
BoolMatrix = NDArray[np.bool_]


@dataclass(frozen=True)
class ImageSets:
    """S sets of images.

    Attributes:
        positives: (S, A) int64, images of one place; some twice where the place has fewer.
        negatives: (S, B) int64, images of B other places.
    """

    positives: Indices
    negatives: Indices

    def __len__(self) -> int:
        return len(self.positives)


@dataclass(frozen=True)
class SetRules:
    """When an image is worth learning from, and how many make a set.

    Attributes:
        gamma: a positive is used when its squared distance to the centre is above (eq. 8).
        gamma_prime: a negative is used when its squared distance to the centre is below (eq. 9).
        positives: A, images of the same place in a set.
        negatives: B, images of other places in a set.
    """

    gamma: float = 0.1
    gamma_prime: float = GAMMA_PRIME
    positives: int = 4
    negatives: int = 4

    @property
    def neighbours(self) -> int:
        """How many of the negatives may be from just beyond the place."""
        return self.negatives // 2


def build_image_sets(
    features: NDArray[np.float32],
    truth: PairTruth,
    rng: np.random.Generator,
    rules: SetRules | None = None,
    anchors: Indices | None = None,
) -> ImageSets:
    """Return the sets that the present features call for, in the order of the anchors.

    Algorithm 1, where an anchor's place is all images of which the truth says so. Where it comes
    from poses these reach as far as eq. 10 does, in every direction. Each negative of a set is
    known to be apart from each of its positives.

    Of the confused images up to half the negatives are from just beyond the place, where there are
    such: that is where a network errs last.

    Args:
        features: (n, D) float32, unit length.
        truth: of the n images.
        rng: what all draws come from.
        rules: margins and sizes; default: the paper's.
        anchors: (M,) int64, the images i that line 2 goes through; default: all n.

    Raises:
        RecognizerError: a feature is not finite, or the truth is of another number of images.
    """
    rules, count = rules or SetRules(), len(features)
    _check(features, truth)
    anchors = np.arange(count) if anchors is None else anchors
    chosen: list[tuple[Indices, Indices]] = []
    for i, distances in _distances_to_centres(features, truth.same, anchors):
        own, different = np.flatnonzero(truth.same[i]), np.flatnonzero(truth.apart[i])
        spread = own[(distances[own] > rules.gamma) & (own != i)]
        confused = different[distances[different] < rules.gamma_prime]
        if len(spread) == 0 and len(confused) == 0:
            continue  # neither line 12 nor line 18 holds: there is nothing to learn here
        just_beyond = rng.permutation(confused[truth.beyond[i, confused]])
        own, neighbours = _choose_neighbours(own, just_beyond, truth.apart, rules)
        spread = spread[np.isin(spread, own)]
        positives = _fill_positives(rng.permutation(spread), own, rules.positives, rng)  # 6, 15-20
        pools = [
            rng.permutation(pool[truth.apart[np.ix_(pool, positives)].all(axis=1)])
            for pool in (confused, different)
        ]
        negatives = _fill_negatives(neighbours, pools, truth, rules.negatives)  # 7, 9-14
        if len(negatives) == rules.negatives:  # else hemmed in by what may be the same place
            chosen.append((positives, negatives))
    return ImageSets(
        np.array([p for p, _ in chosen], np.int64).reshape(-1, rules.positives),
        np.array([n for _, n in chosen], np.int64).reshape(-1, rules.negatives),
    )


def one_of_each(places: Indices, rng: np.random.Generator) -> Indices:
    """Return the sorted indices of one image of each place, drawn at random."""
    return np.sort(_draw_of_each(np.arange(len(places)), places, 1, rng))


def sample_scenes(
    scenes: Indices,
    places: Indices,
    collections: Indices,
    count: int,
    per_scene: int,
    rng: np.random.Generator,
) -> Indices:
    """Return the sorted indices of all images of some places of some scenes, drawn at random.

    Places of one scene are what is most easily confused: rounds that visit few scenes find hard
    negatives among few images. A scene is visited as often as it has places, among those of its
    collection. At each draw every collection has the same chance, as long as it has scenes left.

    Args:
        scenes: (n,) int64, a label per image: one per room, floor or recording.
        places: (n,) int64, a label per image.
        collections: (n,) int64, a label per image, the same for all of a scene.
        count: how many scenes.
        per_scene: how many places of each, at most.
        rng: what all draws come from.
    """
    _, first = np.unique(places, return_index=True)  # one image of each place
    labels, one, sizes = np.unique(scenes[first], return_index=True, return_counts=True)
    _, kinds = np.unique(collections[first[one]], return_inverse=True)
    shares = sizes / np.bincount(kinds, weights=sizes)[kinds] / (kinds.max() + 1)
    drawn = rng.choice(labels, min(count, len(labels)), replace=False, p=shares)
    candidates = first[np.isin(scenes[first], drawn)]
    chosen = places[_draw_of_each(candidates, scenes[candidates], per_scene, rng)]
    return np.flatnonzero(np.isin(places, chosen))


def _check(features: NDArray[np.float32], truth: PairTruth) -> None:
    if len(features) != len(truth.same):
        raise RecognizerError(f"{len(features)} features, and a truth of {len(truth.same)} images")
    bad = np.count_nonzero(~np.isfinite(features).all(axis=1))
    if bad:
        raise RecognizerError(f"the features of {bad} of {len(features)} images are NaN or inf")


def _distances_to_centres(
    features: NDArray[np.float32], same: BoolMatrix, anchors: Indices
) -> Iterator[tuple[int, NDArray[np.float32]]]:
    """Yield each anchor and the (n,) squared distances of all images to its place's centre."""
    lengths = np.einsum("id,id->i", features, features)
    for start in range(0, len(anchors), _BLOCK):
        block = anchors[start : start + _BLOCK]
        centres = np.array([features[same[i]].mean(axis=0) for i in block])
        squares = np.einsum("pd,pd->p", centres, centres)[:, None] + lengths
        yield from zip(block.tolist(), squares - 2.0 * centres @ features.T, strict=True)


def _draw_of_each(
    images: Indices, groups: Indices, count: int, rng: np.random.Generator
) -> Indices:
    """Return at most so many of the images of each group; groups has a label per image."""
    order = rng.permutation(len(images))
    order = order[np.argsort(groups[order], kind="stable")]
    _, first, counts = np.unique(groups[order], return_index=True, return_counts=True)
    return images[order][np.arange(len(images)) - np.repeat(first, counts) < count]


def _choose_neighbours(
    own: Indices, just_beyond: Indices, apart: BoolMatrix, rules: SetRules
) -> tuple[Indices, list[int]]:
    """Return those images of a place that go with some from just beyond it, and these.

    What is just beyond a place on one side is of one place with what is within it on that side: the
    neighbours are chosen first, as long as half of the place is apart from them.
    """
    enough = max(min(rules.positives, len(own)), -(-len(own) // 2))
    neighbours: list[int] = []
    for image in just_beyond.tolist():
        if len(neighbours) == rules.neighbours:
            break
        left = own[apart[image, own]]
        if apart[image, neighbours].all() and len(left) >= enough:
            own = left
            neighbours.append(image)
    return own, neighbours


def _fill_negatives(
    neighbours: list[int], pools: Sequence[Indices], truth: PairTruth, count: int
) -> Indices:
    """Return the neighbours and, up to a count in all, negatives of the first pool, then the next.

    Two of which it is not known whether they show one place stand together only where there are not
    enough others; two of one place never.
    """
    chosen = neighbours
    for compatible in (truth.apart, ~truth.same):
        for pool in pools:
            chosen = _add_compatible(chosen, pool, compatible, count)
    return np.array(chosen, np.int64)


def _add_compatible(
    chosen: list[int], candidates: Indices, compatible: BoolMatrix, count: int
) -> list[int]:
    """Return the chosen and, up to a count in all, the first candidates that fit to all others."""
    together = list(chosen)
    fits: BoolMatrix = np.all(compatible[:, together], axis=1)
    for image in candidates.tolist():
        if len(together) == count:
            break
        if fits[image]:
            together.append(image)
            fits = fits & compatible[image]
    return together


def _fill_positives(
    shuffled: Indices, own: Indices, count: int, rng: np.random.Generator
) -> Indices:
    """Add to the first ones images of the same place, copies only where it has no more (18-20)."""
    positives = shuffled[:count]
    unused = rng.permutation(np.setdiff1d(own, positives))[: count - len(positives)]
    copies = rng.choice(own, count - len(positives) - len(unused))
    return np.concatenate([positives, unused, copies])
