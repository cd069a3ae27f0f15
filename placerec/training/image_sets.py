# SPDX-License-Identifier: Apache-2.0
"""Multi-constraint image sets: what a network still confuses, made ready to learn from.

The names and line numbers are those of the paper's Algorithm 1. Images are named by their index.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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


def build_image_sets(
    features: NDArray[np.float32],
    places: Indices,
    rng: np.random.Generator,
    rules: SetRules | None = None,
    anchors: Indices | None = None,
    alike: BoolMatrix | None = None,
) -> ImageSets:
    """Return the sets that the present features call for, in the order of the anchors.

    Algorithm 1, grouped by place: all images of a place share one centre and one row of distances.

    Args:
        features: (n, D) float32, unit length.
        places: (n,) int64, a label per image.
        rng: what all draws come from.
        rules: margins and sizes; default: the paper's.
        anchors: (M,) int64, the images i that line 2 goes through; default: all n.
        alike: (n, n) bool, pairs that may show one place whatever their labels say, as places
            next to each other do: an image alike to one of a place is never a negative of it, and
            two negatives of a set are alike only where there are not enough others.

    Raises:
        RecognizerError: a feature is not finite, or there are too few places for a set.
    """
    rules, count = rules or SetRules(), len(places)
    _check(features, places, rules)
    anchors = np.arange(count) if anchors is None else anchors
    alike = np.broadcast_to(np.False_, (count, count)) if alike is None else alike
    found: dict[int, tuple[Indices, Indices]] = {}
    for own, distances, members in _by_place(features, places, anchors):
        spread = own[distances[own] > rules.gamma]
        unlike = np.flatnonzero((places != places[own[0]]) & ~alike[own].any(axis=0))
        if len(np.unique(places[unlike])) < rules.negatives:
            continue  # hemmed in by places alike: no set can be completed
        confused = unlike[distances[unlike] < rules.gamma_prime]
        for i in members:
            negatives = _draw_places(confused, places, rules.negatives, rng, alike)  # 7, 9-11
            positives = rng.permutation(spread[spread != anchors[i]])[: rules.positives]  # 6, 15-17
            if len(negatives) == 0 and len(positives) == 0:
                continue  # neither line 12 nor line 18 holds: there is nothing to learn here
            positives = _fill_positives(positives, own, rules.positives, rng)
            if missing := rules.negatives - len(negatives):  # 12-14
                unused = unlike[~np.isin(places[unlike], places[negatives])]
                added = _draw_places(unused, places, missing, rng, alike, negatives.tolist())
                negatives = np.concatenate([negatives, added])
            found[int(i)] = positives, negatives
    chosen = [found[i] for i in sorted(found)]
    return ImageSets(
        np.array([p for p, _ in chosen], np.int64).reshape(-1, rules.positives),
        np.array([n for _, n in chosen], np.int64).reshape(-1, rules.negatives),
    )


def sample_images(places: Indices, per_place: int, rng: np.random.Generator) -> Indices:
    """Return the sorted indices of at most so many images of each place, drawn at random.

    With it the cost of a round of training is that of the places, however many images they have.
    """
    return np.sort(_draw_of_each(np.arange(len(places)), places, per_place, rng))


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


def _check(features: NDArray[np.float32], places: Indices, rules: SetRules) -> None:
    if len(features) != len(places):
        raise RecognizerError(f"{len(features)} features for {len(places)} place labels")
    count = len(np.unique(places))
    if count <= rules.negatives:
        raise RecognizerError(
            f"the images show {count} places, and {rules.negatives + 1} are needed: a set is one "
            f"place and {rules.negatives} others; give more places or ask for fewer negatives"
        )
    bad = np.count_nonzero(~np.isfinite(features).all(axis=1))
    if bad:
        raise RecognizerError(f"the features of {bad} of {len(features)} images are NaN or inf")


def _by_place(
    features: NDArray[np.float32], places: Indices, anchors: Indices
) -> Iterator[tuple[Indices, NDArray[np.float32], Indices]]:
    """Yield for each place of an anchor what its images share.

    Yields:
        the place's images; (n,) squared distances of all images to its centre; which anchors
        are of the place.
    """
    labels, of_anchor = np.unique(places[anchors], return_inverse=True)
    order = np.argsort(places, kind="stable")
    bounds = np.searchsorted(places[order], labels), np.searchsorted(places[order], labels, "right")
    own = [order[start:stop] for start, stop in zip(*bounds, strict=True)]
    centres = np.array([features[images].mean(axis=0) for images in own])
    members = np.split(np.argsort(of_anchor, kind="stable"), np.bincount(of_anchor).cumsum()[:-1])
    lengths = np.einsum("id,id->i", features, features)
    for start in range(0, len(centres), _BLOCK):
        block = centres[start : start + _BLOCK]
        products = block @ features.T
        squares = np.einsum("pd,pd->p", block, block)[:, None] + lengths - 2.0 * products
        for k, distances in enumerate(squares, start):
            yield own[k], distances, members[k]


def _draw_of_each(
    images: Indices, groups: Indices, count: int, rng: np.random.Generator
) -> Indices:
    """Return at most so many of the images of each group; groups has a label per image."""
    order = rng.permutation(len(images))
    order = order[np.argsort(groups[order], kind="stable")]
    _, first, counts = np.unique(groups[order], return_index=True, return_counts=True)
    return images[order][np.arange(len(images)) - np.repeat(first, counts) < count]


def _draw_places(
    candidates: Indices,
    places: Indices,
    count: int,
    rng: np.random.Generator,
    alike: BoolMatrix,
    beside: Sequence[int] = (),
) -> Indices:
    """Return up to so many candidates in random order, no two of one place.

    First come those that are alike neither to each other nor to what they are to stand beside.
    """
    shuffled = rng.permutation(candidates)
    _, first = np.unique(places[shuffled], return_index=True)
    apart: list[int] = []
    rest: list[int] = []
    for image in shuffled[np.sort(first)].tolist():
        if len(apart) == count:
            break
        (rest if alike[image, [*beside, *apart]].any() else apart).append(image)
    return np.array((apart + rest)[:count], np.int64)


def _fill_positives(
    positives: Indices, own: Indices, count: int, rng: np.random.Generator
) -> Indices:
    """Add images of the same place, copies only where it has no more (lines 18-20)."""
    unused = rng.permutation(np.setdiff1d(own, positives))[: count - len(positives)]
    copies = rng.choice(own, count - len(positives) - len(unused))
    return np.concatenate([positives, unused, copies])
