# SPDX-License-Identifier: Apache-2.0
"""What a second look with depth brings on a sequence, by the paper's eq. 10.

    python -m benchmarks.place_recognition.second_look fr1_xyz --limit 0.25
    python -m benchmarks.place_recognition.second_look fr1_desk

As `placerec evaluate SEQUENCE --second-look` does it for images alone: of every third frame with
truth the ten most similar ones, more than 3 s away, are looked at again, by ORB features with depth
as tracking finds them. *Features* is the count by which `run_slam --loop.second-look 10` chooses
whom to verify. *Motion* asks also how far the camera moved, by the rigid motion that takes one's
points onto the other's: the nearer, the more alike. With --limit a place does not end at 0.6.
"""

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from time import perf_counter

import numpy as np
from scipy.spatial.transform import Rotation

from placerec import load
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
SPAN = 2.0 * SAME_PLACE
"""Motion from which on two views have nothing in common: metres plus radians."""
OFF_M, OFF_SHARE = 0.015, 0.02
"""How far a matched point may be off: so much, and this share of its depth."""
ROUNDS = 4

Score = Callable[[Features, Features], float]


def main() -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence")
    parser.add_argument("--limit", type=float, default=SAME_PLACE, help="metres plus radians")
    parser.add_argument("--recognizer", default="learned")
    options = parser.parse_args()
    folder = find_data(options.sequence)
    if folder is None:
        parser.error(f"no such sequence: {options.sequence}")
    dataset, features, camera = _looked_at(read_tum(folder), options.limit)
    recognizer = load(options.recognizer)
    embedded = embed_dataset(recognizer, dataset, EmbeddingCache(recognizer))
    similarities = compare(embedded.embeddings, dataset)
    way = 1.0 - recognizer.min_similarity
    scores: dict[str, Score] = {
        "features": lambda a, b: float(np.log1p(rerank(a, [b], camera)[0]) / np.log(300)),
        "motion": lambda a, b: _nearness(a, b, camera),
    }
    print("| | average precision (95 %) | recall@1 | recall at 100 % P (95 %) | ms a pair |")
    print("|---|---|---:|---|---:|")
    _print("embedding", similarities, dataset, 0.0)
    for name, score in scores.items():
        found, pair_ms = _look_again(similarities, dataset, features, score)
        _print(name, (similarities + way * found) / (1.0 + way), dataset, pair_ms)
    return 0


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
    """Return the (N, N) scores of the ten most similar of each row, and the time of one."""
    possible = np.where(dataset.comparable, similarities, -np.inf)
    scores, taken_s, count = np.zeros(similarities.shape), 0.0, 0
    for row, values in enumerate(possible):
        for column in np.argsort(-values, kind="stable")[:LOOKED_AT].tolist():
            if np.isfinite(values[column]):
                start = perf_counter()
                scores[row, column] = score(features[row], features[column])
                taken_s, count = taken_s + perf_counter() - start, count + 1
    return np.maximum(scores, scores.T), 1e3 * taken_s / max(1, count)


def _nearness(a: Features, b: Features, camera: Camera) -> float:
    """Return 1 for views from one point, 0 from SPAN on or where no motion fits enough matches.

    The motion starts from the match that agrees with most others, and these.
    """
    matches, agree = agreements(a, strongest(a), b, (camera, camera))
    if len(matches) == 0:
        return 0.0
    points, others = a.points_m[matches[:, 0]], b.points_m[matches[:, 1]]
    allowed_m = OFF_M + OFF_SHARE * np.maximum(points[:, 2], others[:, 2])
    fits = agree[np.count_nonzero(agree, axis=1).argmax()]
    for _ in range(ROUNDS):
        if np.count_nonzero(fits) < LEAST_MATCHES:
            return 0.0
        R, t = _rigid(points[fits], others[fits])
        fits = np.linalg.norm(R.apply(points) + t - others, axis=1) < allowed_m
    return float(max(0.0, 1.0 - (np.linalg.norm(t) + R.magnitude()) / SPAN))


def _rigid(points: FloatArray, others: FloatArray) -> tuple[Rotation, FloatArray]:
    """Return the rotation and translation that take (N, 3) points onto others best."""
    middle, other = points.mean(axis=0), others.mean(axis=0)
    R, _ = Rotation.align_vectors(others - other, points - middle)
    return R, other - R.apply(middle)


def _print(
    name: str, similarities: Similarities | FloatArray, dataset: PlaceDataset, pair_ms: float
) -> None:
    found = judge(similarities.astype(np.float32), dataset)
    within = bootstrap(found, dataset)
    ap, recall = within.average_precision, within.recall_at_full_precision
    print(
        f"| {name} | {found.pair_curve.area:.3f} ({ap[0]:.2f} to {ap[1]:.2f}) | "
        f"{found.recall_at_1:.3f} | {found.best_match_curve.recall_at_full_precision:.3f} "
        f"({recall[0]:.2f} to {recall[1]:.2f}) | {pair_ms:.1f} |"
    )


if __name__ == "__main__":
    sys.exit(main())
