# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.evaluation import measurement
from placerec.evaluation.measurement import measure_cost


class Recorder:
    """Notes the shapes of what it is to compare."""

    looks_back = 3

    def __init__(self):
        self.asked = []

    def compare(self, queries, references):
        self.asked.append((queries.shape, references.shape))
        return np.ones((len(queries), len(references)), np.float32)


def test_cost_of_an_embedding():
    embeddings = np.full((3, 64), 0.125, np.float32)
    found = measure_cost(embeddings, np.array([0.5, 0.002, 0.001]))
    assert found.embed_ms == pytest.approx(2.0)  # the median: the first image warms things up
    assert found.dimension == 64
    assert found.embedding_bytes == 256
    assert found.compare_ms > 0.0


def test_an_embedding_of_any_shape_is_compared_as_its_recognizer_does():
    recorder = Recorder()
    found = measure_cost(np.ones((2, 14, 512), np.float32), np.ones(2), recorder)
    assert (found.dimension, found.embedding_bytes) == (14 * 512, 14 * 512 * 4)
    assert set(recorder.asked) == {((4, 14, 512), (9362, 14, 512))}


@pytest.mark.parametrize(("dimension", "count"), [(16, 10_000), (256 * 13 * 13, 1551)])
def test_long_embeddings_are_compared_in_batches_that_fit_into_memory(dimension, count):
    recorder = Recorder()
    measure_cost(np.ones((1, dimension), np.float32), np.ones(1), recorder)
    assert set(recorder.asked) == {((4, dimension), (count, dimension))}


def test_what_takes_long_is_not_repeated_as_often(monkeypatch):
    recorder, times = Recorder(), iter(range(1000))
    monkeypatch.setattr(measurement, "perf_counter", lambda: next(times) * 0.4)
    found = measure_cost(np.ones((1, 2), np.float32), np.ones(1), recorder)
    assert len(recorder.asked) == 3  # more than a second
    assert found.compare_ms == pytest.approx(400.0 / 10_000)
