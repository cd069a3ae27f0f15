# SPDX-License-Identifier: Apache-2.0
"""What building image sets costs as images, and as places, are added.

Run as `python benchmarks/image_sets_cost.py`. "literal" goes through all pairs of images as
Algorithm 1 is written; "grouped" is `build_image_sets` with one anchor per place; "sampled" looks
at eight images of each place, as a round of training does.
"""

import time
from collections.abc import Callable

import numpy as np

from placerec.training.image_sets import build_image_sets, sample_images

DIMENSION = 256
CASES = [(100, 10), (100, 20), (100, 40), (100, 80), (200, 10), (400, 10), (800, 10)]
LITERAL_MAX_IMAGES = 2000


def main() -> None:
    """Print one row per number of places and of images in each."""
    print(f"{'places':>7} {'images':>7} {'literal':>10} {'grouped':>10} {'sampled':>10}  seconds")
    for places, per_place in CASES:
        rng = np.random.default_rng(0)
        labels = np.repeat(np.arange(places), per_place)
        features = rng.normal(size=(len(labels), DIMENSION)).astype(np.float32)
        features += 6.0 * rng.normal(size=(places, DIMENSION)).astype(np.float32)[labels] + 4.0
        features /= np.linalg.norm(features, axis=1, keepdims=True)
        literal = (
            _seconds(lambda f=features, p=labels: _literal(f, p))
            if len(labels) <= LITERAL_MAX_IMAGES
            else np.nan
        )
        grouped = _seconds(lambda f=features, p=labels: _one_per_place(f, p))
        sampled = _seconds(lambda f=features, p=labels: _sampled(f, p))
        print(f"{places:7d} {len(labels):7d} {literal:10.3f} {grouped:10.3f} {sampled:10.3f}")


def _literal(features: np.ndarray, places: np.ndarray) -> int:
    sets = 0
    for i in range(len(places)):
        centre = features[places == places[i]].mean(axis=0)
        distances = ((features - centre) ** 2).sum(axis=1)
        same = places == places[i]
        sets += bool((distances[same] > 0.1).any() or (distances[~same] < 0.4).any())
    return sets


def _one_per_place(features: np.ndarray, places: np.ndarray) -> int:
    rng = np.random.default_rng(1)
    return len(build_image_sets(features, places, rng, anchors=sample_images(places, 1, rng)))


def _sampled(features: np.ndarray, places: np.ndarray) -> int:
    rng = np.random.default_rng(1)
    images = sample_images(places, 8, rng)
    return _one_per_place(features[images], places[images])


def _seconds(run: Callable[[], int]) -> float:
    start_s = time.perf_counter()
    run()
    return time.perf_counter() - start_s


if __name__ == "__main__":
    main()
