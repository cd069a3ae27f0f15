# SPDX-License-Identifier: Apache-2.0
"""How many true pairs a threshold cuts off, and how many wrong ones pass it: a Markdown table.

    python -m benchmarks.place_recognition.adaptive_threshold DATA... [--recognizer NAME]
        [--resamples 200]

From the root of the repository; DATA as `placerec evaluate` takes it. Three thresholds are compared
on all pairs that count: the calibrated one, the adaptive one, and the oracle's, which knows the
truth and cuts just 5 % of the true pairs off: none lets fewer wrong ones pass then. Images come in
their order, and each pair is judged by the threshold that was known when its later image came.

What a run knows of its own images without recognising any is taken from the recording: of TUM RGB-D
folders how far the camera went within three seconds, by the true poses, which odometry would know
about as well; of clips and drives, whose poses nobody knows, that images fewer than three frames
apart are of one place.
"""

import argparse
import re
import sys
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.certificate import own_fingerprint
from placerec.checked_recognizer import CheckedRecognizer
from placerec.datasets import PlaceDataset, open_dataset
from placerec.datasets.pose_distance import SAME_PLACE, pose_distance
from placerec.errors import LoopcloseError, RecognizerError
from placerec.evaluation.bootstrap import draws, interval, resampling_units
from placerec.evaluation.embeddings import EmbeddingCache, embed_dataset
from placerec.recognizer import load
from slam.loops.candidates.adaptive_threshold import AdaptiveThreshold

MOST_CUT = 0.05
"""Share of the true pairs that the oracle cuts off."""
KNOWN_S = 3.0
PLACE_FRAMES = 3
HEADER = (
    "| data | threshold | in the end | true pairs cut | wrong pairs passing |\n"
    "| --- | --- | --: | --: | --: |"
)

FloatArray = NDArray[np.float64]


def main() -> int:
    """Print the table, a dataset at a time."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("data", nargs="+")
    parser.add_argument("--recognizer", default="learned")
    parser.add_argument("--resamples", type=int, default=200)
    options = parser.parse_args()
    print(HEADER)
    try:
        for source in options.data:
            for line in table(source, options.recognizer, options.resamples):
                print(line, flush=True)
    except LoopcloseError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def table(source: str, name: str, resamples: int) -> list[str]:
    """Return a line for each threshold, and what the adaptive one says of its reliability."""
    dataset = open_dataset(source)
    if dataset.skipped:
        raise RecognizerError(f"{dataset.name} has broken images; give a folder without")
    recognizer = load(name)
    cache = EmbeddingCache(recognizer) if own_fingerprint(recognizer) else None
    embeddings = embed_dataset(recognizer, dataset, cache).embeddings
    checked = CheckedRecognizer(recognizer, name)
    similarities = checked.compare(embeddings, embeddings)
    known, order = distances_known(dataset)
    adaptive = AdaptiveThreshold(checked.min_similarity)
    then = thresholds_on_the_way(adaptive, similarities[np.ix_(order, order)], known)
    at_image = np.empty(len(dataset))
    at_image[order] = then
    rank = np.empty(len(dataset), int)
    rank[order] = np.arange(len(dataset))
    pairs = Pairs(dataset, similarities, rank)
    fit = adaptive.fit(adaptive.min_similarity)
    oracle = float(np.quantile(pairs.similarity[pairs.is_true], MOST_CUT))
    chosen = {
        "calibrated": (checked.min_similarity, np.full(len(dataset), checked.min_similarity)),
        "adaptive": (fit.min_similarity, at_image),
        "oracle": (oracle, np.full(len(dataset), oracle)),
    }
    return [
        f"| {dataset.name} | {kind} | {last:.3f} | {pairs.shares(at, resamples)} |"
        for kind, (last, at) in chosen.items()
    ] + [f"| {dataset.name} | (adaptive: {fit.explanation}) | | | |"]


def distances_known(dataset: PlaceDataset) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return what a run knows of its pairs, as `AdaptiveThreshold.meet`, and the images' order.

    The (N, N) distances are in that order: that of time, and references before queries.
    """
    count = len(dataset)
    order = np.arange(count)
    if not np.array_equal(dataset.queries, dataset.references):
        order = np.concatenate([dataset.references, dataset.queries])
    if dataset.timestamps_s is None or dataset.positions_m is None or dataset.quaternions is None:
        clips, numbers = zip(*(_clip(dataset.paths[i]) for i in order), strict=True)
        apart = np.abs(np.subtract.outer(numbers, numbers))
        is_near = (apart < PLACE_FRAMES) & np.equal.outer(clips, clips)
        # Nobody knows how near: as far as one place goes.
        return np.where(is_near, np.nextafter(1.0, 0.0), np.nan), order
    poses, times_s = (dataset.positions_m[order], dataset.quaternions[order]), dataset.timestamps_s
    apart_s = np.abs(np.subtract.outer(times_s[order], times_s[order]))
    shares = pose_distance(*poses, *poses) / SAME_PLACE
    return np.where(apart_s <= KNOWN_S, shares, np.nan), order


def _clip(path: Path) -> tuple[str, int]:
    """Return what a file's name has before its number, the folder included, and the number."""
    match = re.search(r"^(.*?)(\d+)$", path.stem)
    if match is None:
        raise RecognizerError(f"the image has no number in its name: {path}")
    return f"{path.parent}/{match[1]}", int(match[2])


def thresholds_on_the_way(
    adaptive: AdaptiveThreshold, similarities: NDArray[np.float32], known: FloatArray
) -> FloatArray:
    """Return (N,) the threshold when each image came; all are met after it."""
    then = np.empty(len(known))
    for i, (row, distances) in enumerate(zip(similarities, known, strict=True)):
        then[i] = adaptive.min_similarity
        adaptive.meet(row[:i], distances[:i])
    return then


class Pairs:
    """All (M,) pairs of a dataset that count, each once."""

    def __init__(
        self, dataset: PlaceDataset, similarities: NDArray[np.float32], rank: NDArray[np.int64]
    ) -> None:
        rows, columns = np.nonzero(dataset.pairs)
        self.is_true = dataset.same_place[rows, columns]
        self._first, self._second = dataset.queries[rows], dataset.references[columns]
        self.similarity = similarities[self._first, self._second]
        is_later = rank[self._first] > rank[self._second]
        self._later = np.where(is_later, self._first, self._second)
        self._unit = resampling_units(dataset)

    def shares(self, thresholds: FloatArray, resamples: int) -> str:
        """Return two cells, cut and passing, by the (N,) thresholds when images came, with 95 %."""
        reaches = self.similarity >= thresholds[self._later]
        cut = self.is_true & ~reaches
        passing = ~self.is_true & reaches
        cells = [
            float(cut.sum() / self.is_true.sum()),
            float(passing.sum() / (~self.is_true).sum()),
        ]
        drawn: tuple[list[float], list[float]] = [], []
        for images in islice(draws(self._unit, seed=0), resamples):
            weights = images[self._first] * images[self._second]
            total, right = int(weights.sum()), int(weights[self.is_true].sum())
            drawn[0].append(float(weights[cut].sum() / max(1, right)))
            drawn[1].append(float(weights[passing].sum() / max(1, total - right)))
        return " | ".join(_with_interval(*each) for each in zip(cells, drawn, strict=True))


def _with_interval(share: float, drawn: list[float]) -> str:
    low, high = interval(drawn)
    return f"{share:.1%} ({low:.1%} to {high:.1%})"


if __name__ == "__main__":
    sys.exit(main())
