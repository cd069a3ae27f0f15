# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from placerec.datasets import open_dataset
from placerec.evaluation import measurement
from placerec.evaluation.measurement import Failed, Measured, measure, measure_cost


class Grey:
    """The image itself, without its mean."""

    min_similarity = 0.5

    def embed(self, image):
        values = image.astype(np.float32).ravel() - image.mean()
        return values / np.linalg.norm(values)


class Kept(Grey):
    fingerprint = "grey"
    weights = "none, it is but the image"
    trained_on = ("second", "third")


@pytest.fixture(autouse=True)
def user_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def dataset(tmp_path, write_image):
    for i in range(6):
        for drive in ("query", "ref"):
            write_image(tmp_path / f"drives/{drive}/{i}.png", seed=i)
    rows = "".join(f"{i},{i}\n" for i in range(6))
    (tmp_path / "drives/ground_truth.csv").write_text(f"query,refs\n{rows}")
    return open_dataset(str(tmp_path / "drives"))


def test_what_is_measured(dataset):
    found = measure("grey", Grey(), dataset)
    assert isinstance(found, Measured)
    assert (found.recognizer, found.weights, found.trained_on) == ("grey", "", ())
    assert found.evaluation.pair_curve.area == 1.0
    assert found.intervals.average_precision == (1.0, 1.0)
    assert found.cost.dimension == 12 * 16 * 3
    assert found.timed_on is None


class Compares(Kept):
    """The image as it is, compared by its mean difference."""

    fingerprint = "compares"

    def __init__(self, answer=None):
        self.answer = answer

    def embed(self, image):
        return image.astype(np.float32)

    def compare(self, queries, references):
        if self.answer is not None:
            return self.answer
        return 1 - abs(queries[:, None] - references[None]).mean(axis=(2, 3, 4)) / 255


def test_a_recognizer_that_compares_itself_is_measured_by_that_and_kept(dataset, monkeypatch):
    monkeypatch.setattr(measurement, "_BATCH", 50)
    for found in (measure("mine", Compares(), dataset) for _ in range(2)):
        assert found.evaluation.pair_curve.area == 1.0
        assert found.evaluation.similarities.diagonal() == pytest.approx(np.ones(6))
        assert 0.4 < found.evaluation.similarities.min() < 0.9
        assert (found.cost.dimension, found.cost.embedding_bytes) == (576, 2304)


def test_a_compare_that_misbehaves_is_the_answer(dataset):
    found = measure("mine", Compares(np.zeros(3)), dataset)
    assert isinstance(found, Failed)
    assert found.why.startswith("recognizer 'mine' returned similarities of shape (3,)")


def test_only_a_recognizer_with_a_fingerprint_is_kept_and_only_if_wished(
    dataset, user_cache, later_run
):
    measure("grey", Grey(), dataset)
    measure("kept", Kept(), dataset, use_cache=False)
    assert not user_cache.exists()
    measure("kept", Kept(), dataset)
    assert user_cache.exists()
    later_run()
    again = measure("kept", Kept(), dataset)
    assert again.timed_on is not None
    assert again.weights == "none, it is but the image"


def test_data_that_was_trained_on_is_marked_wherever_it_is_part_of(dataset):
    both = replace(dataset, name="first+second")
    assert measure("kept", Kept(), both).trained_on == ("second",)
    assert measure("kept", Kept(), replace(dataset, name="first")).trained_on == ()


def test_a_failure_is_an_answer_of_one_line(dataset):
    class Broken(Grey):
        def embed(self, image):
            raise ValueError("two\nlines")

    class Worse(Grey):
        @property
        def fingerprint(self):
            raise OSError("no weights there")

    broken = measure("broken", Broken(), dataset)
    assert broken == Failed(dataset, "broken", "recognizer 'Broken' failed: ValueError: two lines")
    assert measure("worse", Worse(), dataset).why == "OSError: no weights there"


def test_being_stopped_is_no_failure(dataset):
    class Slow(Grey):
        def embed(self, image):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        measure("slow", Slow(), dataset)


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
