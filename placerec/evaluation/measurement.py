# SPDX-License-Identifier: Apache-2.0
"""One recognizer on one dataset: what was measured, or why nothing was."""

from dataclasses import dataclass
from datetime import date
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from placerec.certificate import own_fingerprint
from placerec.checked_recognizer import COSINES, CheckedRecognizer, Comparer, Embeddings
from placerec.datasets import PlaceDataset
from placerec.errors import cause_of
from placerec.evaluation.bootstrap import Intervals, bootstrap
from placerec.evaluation.embeddings import EmbeddingCache, embed_dataset
from placerec.evaluation.precision_recall import Evaluation, compare, judge
from placerec.evaluation.second_look import LocalFeatures, look_again
from placerec.files import Progress
from placerec.recognizer import PlaceRecognizer

_BATCH = 10_000
_MAX_BATCH_BYTES = 256 * 2**20
"""Fewer are compared at a time where they would take up more than this."""
_REPEATS = 30
_ENOUGH_S = 1.0
"""No more tries after so long."""


@dataclass(frozen=True)
class Cost:
    """What one image costs.

    Attributes:
        embed_ms: median time to embed it.
        compare_ms: time to compare it with one other, in a batch of 10,000 (long ones fewer), as
            a map that is being made does it, the recognizer's look back included; the least of
            several tries, because one that took longer has waited for other work of the machine.
        dimension: how many values an embedding has.
        embedding_bytes: what they take up in memory.
    """

    embed_ms: float
    compare_ms: float
    dimension: int
    embedding_bytes: int


def measure_cost(
    embeddings: Embeddings, embed_s: NDArray[np.float64], comparer: Comparer = COSINES
) -> Cost:
    """Return the cost of the recognizer that made (N, *S) embeddings in (N,) seconds each.

    Raises:
        RecognizerError: the embeddings cannot be compared.
    """
    one = embeddings[:1]
    count = max(1, min(_BATCH, _MAX_BATCH_BYTES // one.nbytes))
    batch, queries = one.repeat(count, axis=0), one.repeat(1 + comparer.looks_back, axis=0)
    compare_s: list[float] = []
    while len(compare_s) < _REPEATS and sum(compare_s) < _ENOUGH_S:
        start = perf_counter()
        comparer.compare(queries, batch)
        compare_s.append(perf_counter() - start)
    return Cost(
        embed_ms=1e3 * float(np.median(embed_s)),
        compare_ms=1e3 * min(compare_s) / count,
        dimension=one.size,
        embedding_bytes=one.nbytes,
    )


@dataclass(frozen=True)
class Measured:
    """A recognizer on a dataset.

    Attributes:
        dataset: what it was measured on.
        recognizer: the name it was loaded by.
        weights: what the recognizer says that it runs on, "" where it says nothing.
        trained_on: those parts of the dataset's name that the recognizer says it was trained on.
        evaluation: how well it tells places apart.
        intervals: how far that would move with other images.
        cost: what it takes.
        timed_on: the day the oldest embedding was timed on, None where that was in this run.
    """

    dataset: PlaceDataset
    recognizer: str
    weights: str
    trained_on: tuple[str, ...]
    evaluation: Evaluation
    intervals: Intervals
    cost: Cost
    timed_on: date | None


@dataclass(frozen=True)
class Failed:
    """A recognizer of which nothing could be measured on a dataset, and why, in one line."""

    dataset: PlaceDataset
    recognizer: str
    why: str


Measurement = Measured | Failed


def measure(
    name: str,
    recognizer: PlaceRecognizer,
    dataset: PlaceDataset,
    *,
    use_cache: bool = True,
    second_look: bool = False,
    progress: Progress | None = None,
) -> Measurement:
    """Return what a recognizer does on a dataset; whatever goes wrong with it is the answer.

    Args:
        name: what the recognizer was loaded by.
        recognizer: any; optional members of it are `fingerprint: str`, which its kept embeddings
            are known by, `weights: str`, a line about what it runs on, and
            `trained_on: tuple[str, ...]`, names of datasets.
        dataset: images, and the truth about them.
        use_cache: look embeddings up that were kept, and keep them.
        second_look: look again at each query's most similar references, by the recognizer's own
            `rerank` where it has one, else by local features.
        progress: told of every image that is done.
    """
    try:
        has_cache = use_cache and own_fingerprint(recognizer) is not None
        cache = EmbeddingCache(recognizer) if has_cache else None
        embedded = embed_dataset(recognizer, dataset, cache, progress)
        comparer = CheckedRecognizer(recognizer, name)
        weights: object = getattr(recognizer, "weights", "")
        trained_on = set(getattr(recognizer, "trained_on", ()))
        similarities = compare(embedded.embeddings, dataset, comparer)
        if second_look:
            look = comparer if comparer.can_rerank else LocalFeatures()
            similarities = look_again(similarities, dataset, look, comparer.min_similarity)
        found = judge(similarities, dataset)
        return Measured(
            dataset=dataset,
            recognizer=name,
            weights=weights if isinstance(weights, str) else "",
            trained_on=tuple(part for part in dataset.name.split("+") if part in trained_on),
            evaluation=found,
            intervals=bootstrap(found, dataset),
            cost=measure_cost(embedded.embeddings, embedded.seconds, comparer),
            timed_on=embedded.oldest,
        )
    except Exception as error:  # hours of work on others are not to be lost to one
        return Failed(dataset, name, cause_of(error))
