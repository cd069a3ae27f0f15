# SPDX-License-Identifier: Apache-2.0
"""What a second look with depth brings on sequences, by the paper's eq. 10.

    python -m benchmarks.place_recognition.second_look FOLDER... [--limit 0.25]

As `placerec evaluate SEQUENCE --second-look` does it for images alone: of every third frame with
truth the ten most similar ones, more than 3 s away, are looked at again, by ORB features with depth
as tracking finds them. *Features* is the count by which `run_slam --loop.second-look 10` chooses
whom to verify, added to the similarity. *Motion* is how far the camera moved, by the rigid motion
that takes one's points onto the other's: where there is one it alone tells, the similarity of the
embeddings all else. With --limit a place does not end at 0.6. Of several sequences the means are
told, too.

`python -m benchmarks.training_scenes OUT --photographs ie_tower:validation --paths --depth` makes
sequences to choose on.
"""

import argparse
import math
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean
from time import perf_counter

import numpy as np
from scipy.spatial.transform import Rotation

from placerec import PlaceRecognizer, load
from placerec.checked_recognizer import Similarities
from placerec.datasets import PlaceDataset
from placerec.datasets.names import find_data
from placerec.datasets.pose_distance import SAME_PLACE, pose_distance
from placerec.datasets.tum import read_tum
from placerec.evaluation.bootstrap import bootstrap
from placerec.evaluation.embeddings import EmbeddingCache, embed_dataset
from placerec.evaluation.precision_recall import compare, judge
from placerec.evaluation.second_look import LOOKED_AT
from slam.config import Config
from slam.datasets.formats import open_sequence
from slam.geometry.features import FeatureExtractor, grey_of
from slam.loops.candidates.second_look import agreements, rerank, strongest
from slam.types import Camera, Features, FloatArray

LEAST_MATCHES = 12
DOUBT = 4.0
"""Over the number of matches that bear a motion out, what it ranks as longer among those within the
limit: metres plus radians. What repeats itself may be matched twelve times in a wrong place."""
OFF_M, OFF_SHARE = 0.015, 0.02
"""How far a matched point may be off in the end: so much, and this share of its depth."""
LENIENCE = (2.0, 5.0 / 3.0, 4.0 / 3.0, 1.0)
"""How many times as far it may be off in each round."""

Score = Callable[[Features, Features], float]
Figures = tuple[float, float, float, float]
"""Average precision, recall@1, recall at 100 % precision, area under the best-match curve."""


def main() -> int:
    """Print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequences", nargs="+")
    parser.add_argument("--limit", type=float, default=SAME_PLACE, help="metres plus radians")
    parser.add_argument("--recognizer", default="learned")
    options = parser.parse_args()
    folders = [find_data(each) for each in options.sequences]
    if None in folders:
        parser.error(f"no such sequence: {options.sequences[folders.index(None)]}")
    recognizer, of_all = load(options.recognizer), dict[str, list[Figures]]()
    for folder in filter(None, folders):
        print(
            f"| {folder.name} | average precision (95 %) | recall@1 | recall at 100 % P (95 %) |",
            end="",
        )
        print(" area | ms a pair |\n|---|---|---:|---|---:|---:|")
        for name, figures in _looks(folder, options.limit, recognizer):
            of_all.setdefault(name, []).append(figures)
        print()
    if len(folders) > 1:
        print("| mean | average precision | recall@1 | recall at 100 % P | area |")
        print("|---|---:|---:|---:|---:|")
        for name, figures_of_each in of_all.items():
            means = (f"{fmean(values):.3f}" for values in zip(*figures_of_each, strict=True))
            print(f"| {name} | {' | '.join(means)} |")
    return 0


def _looks(
    folder: Path, limit: float, recognizer: PlaceRecognizer
) -> Iterator[tuple[str, Figures]]:
    """Print a row for each way to look, and yield its name and figures."""
    dataset, features, camera = _looked_at(read_tum(folder), limit)
    embedded = embed_dataset(recognizer, dataset, EmbeddingCache(recognizer))
    similarities = compare(embedded.embeddings, dataset)
    yield "embedding", _print("embedding", similarities, dataset, 0.0)

    def count(a: Features, b: Features) -> float:
        return float(np.log1p(rerank(a, [b], camera)[0]) / np.log(300))

    counts, pair_ms = _look_again(similarities, dataset, features, count)
    way = 1.0 - recognizer.min_similarity
    both = (similarities + way * np.nan_to_num(counts)) / (1.0 + way)
    yield "features", _print("features", both, dataset, pair_ms)

    def verdict(a: Features, b: Features) -> float:
        return _verdict(_motion(a, b, camera), limit)

    verdicts, pair_ms = _look_again(similarities, dataset, features, verdict)
    told = np.where(np.isnan(verdicts), similarities, verdicts)
    yield "motion", _print("motion", told, dataset, pair_ms)


def _looked_at(dataset: PlaceDataset, limit: float) -> tuple[PlaceDataset, list[Features], Camera]:
    """Return the frames that have depth, with their features."""
    assert dataset.positions_m is not None and dataset.quaternions is not None
    stamps_s = dataset.timestamps_s
    assert stamps_s is not None
    poses = dataset.positions_m, dataset.quaternions
    dataset = replace(dataset, same_place=pose_distance(*poses, *poses) < limit)
    config = Config()
    sequence = open_sequence(dataset.paths[0].parents[1], config.input)
    extractor = FeatureExtractor(sequence.camera, config.features)
    wanted = {round(stamp_s, 4): k for k, stamp_s in enumerate(stamps_s.tolist())}
    found: dict[int, Features] = {}
    for frame in sequence:
        if (k := wanted.get(round(frame.timestamp_s, 4))) is not None:
            found[k] = extractor.extract(grey_of(frame.rgb), frame.depth_m)
    kept = np.isin(np.arange(len(dataset)), list(found))
    return dataset.subset(kept), [found[k] for k in sorted(found)], sequence.camera


def _look_again(
    similarities: Similarities, dataset: PlaceDataset, features: Sequence[Features], score: Score
) -> tuple[FloatArray, float]:
    """Return (N, N) scores of the ten most similar of each row, and the time of one.

    NaN for the others, and where the score is. Of two ways to look at a pair the larger counts.
    """
    possible = np.where(dataset.comparable, similarities, -np.inf)
    scores, taken_s, count = np.full(similarities.shape, np.nan), 0.0, 0
    for row, values in enumerate(possible):
        for column in np.argsort(-values, kind="stable")[:LOOKED_AT].tolist():
            if np.isfinite(values[column]):
                start = perf_counter()
                scores[row, column] = score(features[row], features[column])
                taken_s, count = taken_s + perf_counter() - start, count + 1
    return np.fmax(scores, scores.T), 1e3 * taken_s / max(1, count)


@dataclass(frozen=True)
class Motion:
    """How the camera moved from one view to another.

    Attributes:
        distance: of eq. 10, metres plus radians.
        matches: how many bear it out.
    """

    distance: float
    matches: int


def _verdict(motion: Motion | None, limit: float) -> float:
    """Return more than any similarity for a motion within the limit, less for one beyond it.

    The nearer, the more; NaN where there is no motion.
    """
    if motion is None:
        return math.nan
    if motion.distance >= limit:
        return -1.0 - motion.distance
    return 2.0 + limit - motion.distance - DOUBT / motion.matches


def _motion(a: Features, b: Features, camera: Camera) -> Motion | None:
    """Return the rigid motion of most matches, None where too few fit one.

    It starts from the match that agrees with most others, and these.
    """
    matches, agree = agreements(a, strongest(a), b, (camera, camera))
    if len(matches) == 0:
        return None
    points, others = a.points_m[matches[:, 0]], b.points_m[matches[:, 1]]
    allowed_m = OFF_M + OFF_SHARE * np.maximum(points[:, 2], others[:, 2])
    fits = agree[np.count_nonzero(agree, axis=1).argmax()]
    distance = 0.0
    for lenience in LENIENCE:
        if np.count_nonzero(fits) < LEAST_MATCHES:
            return None
        R, t = _rigid(points[fits], others[fits], allowed_m[fits] ** -2)
        fits = np.linalg.norm(R.apply(points) + t - others, axis=1) < lenience * allowed_m
        distance = float(np.linalg.norm(t) + R.magnitude())
    count = int(np.count_nonzero(fits))
    return Motion(distance, count) if count >= LEAST_MATCHES else None


def _rigid(
    points: FloatArray, others: FloatArray, weights: FloatArray
) -> tuple[Rotation, FloatArray]:
    """Return the rotation and translation that take (N, 3) points onto others best."""
    middle, other = (np.average(each, axis=0, weights=weights) for each in (points, others))
    R, _ = Rotation.align_vectors(others - other, points - middle, weights=weights)
    return R, other - R.apply(middle)


def _print(
    name: str, similarities: Similarities | FloatArray, dataset: PlaceDataset, pair_ms: float
) -> Figures:
    found = judge(similarities.astype(np.float32), dataset)
    within, best = bootstrap(found, dataset), found.best_match_curve
    ap, recall = within.average_precision, within.recall_at_full_precision
    print(
        f"| {name} | {found.pair_curve.area:.3f} ({ap[0]:.2f} to {ap[1]:.2f}) | "
        f"{found.recall_at_1:.3f} | {best.recall_at_full_precision:.3f} "
        f"({recall[0]:.2f} to {recall[1]:.2f}) | {best.area:.3f} | {pair_ms:.1f} |"
    )
    return found.pair_curve.area, found.recall_at_1, best.recall_at_full_precision, best.area


if __name__ == "__main__":
    sys.exit(main())
