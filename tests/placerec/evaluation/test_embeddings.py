# SPDX-License-Identifier: Apache-2.0
import shutil
from datetime import date

import numpy as np
import pytest

from placerec.certificate import own_fingerprint
from placerec.datasets import open_dataset
from placerec.errors import RecognizerError
from placerec.evaluation import embeddings
from placerec.evaluation.embeddings import EmbeddingCache, embed_dataset


class Marked:
    min_similarity = 0.5

    def __init__(self, fingerprint="one"):
        self.fingerprint = fingerprint


class Other(Marked):
    pass


VECTOR = np.array([0.6, 0.8], np.float32)


@pytest.fixture
def image(tmp_path, write_image):
    return write_image(tmp_path / "image.png")


def test_what_was_kept_is_found_again_with_its_time_and_day(tmp_path, image):
    assert EmbeddingCache(Marked(), tmp_path).find(image) is None
    EmbeddingCache(Marked(), tmp_path).keep(image, VECTOR, 0.25)
    kept = EmbeddingCache(Marked(), tmp_path).find(image)
    assert kept.vector.tobytes() == VECTOR.tobytes()
    assert kept.seconds == 0.25
    assert kept.made_on is None


def test_arrays_of_any_shape_are_kept(tmp_path, image):
    regions = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    EmbeddingCache(Marked(), tmp_path).keep(image, regions, 0.25)
    kept = EmbeddingCache(Marked(), tmp_path).find(image).vector
    assert kept.dtype == np.float32
    assert np.array_equal(kept, regions)


def test_what_an_earlier_run_made_tells_its_day(tmp_path, image, later_run):
    EmbeddingCache(Marked(), tmp_path).keep(image, VECTOR, 0.25)
    later_run()
    made_on = EmbeddingCache(Marked(), tmp_path).find(image).made_on
    assert abs((made_on - date.today()).days) <= 1


def test_the_content_counts_not_the_name(tmp_path, image, write_image):
    cache = EmbeddingCache(Marked(), tmp_path)
    cache.keep(image, VECTOR, 0.25)
    assert cache.find(shutil.copy(image, tmp_path / "moved.png")) is not None
    write_image(image, seed=1)
    assert cache.find(image) is None


@pytest.mark.parametrize("recognizer", [Marked("two"), Other("one")])
def test_another_recognizer_finds_nothing(tmp_path, image, recognizer):
    EmbeddingCache(Marked("one"), tmp_path).keep(image, VECTOR, 0.25)
    assert EmbeddingCache(recognizer, tmp_path).find(image) is None


def test_another_version_of_a_library_finds_nothing(tmp_path, image, monkeypatch):
    EmbeddingCache(Marked(), tmp_path).keep(image, VECTOR, 0.25)
    monkeypatch.setattr(embeddings, "version", lambda library: "another")
    assert EmbeddingCache(Marked(), tmp_path).find(image) is None


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[:-1],
        lambda content: content[:40],
        lambda content: content[:-1] + bytes([content[-1] ^ 1]),
        lambda content: content + b"\0\0\0\0",
    ],
)
def test_a_damaged_entry_is_no_entry_and_is_replaced(tmp_path, image, damage):
    cache = EmbeddingCache(Marked(), tmp_path)
    cache.keep(image, VECTOR, 0.25)
    (file,) = (path for path in (tmp_path / "embeddings").rglob("*") if path.is_file())
    file.write_bytes(damage(file.read_bytes()))
    assert cache.find(image) is None
    cache.keep(image, VECTOR, 0.5)
    assert cache.find(image).seconds == 0.5


def test_where_nothing_can_be_kept_nothing_is_said(tmp_path, image):
    (tmp_path / "embeddings").write_text("a file where the folder should be")
    cache = EmbeddingCache(Marked(), tmp_path)
    cache.keep(image, VECTOR, 0.25)
    assert cache.find(image) is None


def test_a_missing_image_is_found_missing_by_whoever_reads_it(tmp_path):
    assert EmbeddingCache(Marked(), tmp_path).find(tmp_path / "missing.png") is None


def test_without_a_fingerprint_there_is_no_cache(tmp_path):
    assert own_fingerprint(Marked()) == "one"
    for fingerprint in (None, 5):
        assert own_fingerprint(Marked(fingerprint)) is None
        with pytest.raises(RecognizerError, match="'Marked' has no fingerprint"):
            EmbeddingCache(Marked(fingerprint), tmp_path)


class Brightness:
    """Two values whose direction is how bright the image is."""

    min_similarity = 0.5
    fingerprint = "brightness"

    def __init__(self, size=2, length=1.0):
        self.size, self.length = size, length
        self.calls = 0

    def embed(self, image):
        self.calls += 1
        vector = np.zeros(self.size, np.float32)
        angle = image.mean() / 255
        vector[:2] = np.cos(angle), np.sin(angle)
        return vector * self.length


@pytest.fixture
def dataset(tmp_path, write_image):
    for i in range(3):
        for drive in ("query", "ref"):
            write_image(tmp_path / f"drives/{drive}/{i}.png", seed=i)
    return open_dataset(str(tmp_path / "drives"))


@pytest.fixture
def cache(tmp_path):
    return EmbeddingCache(Brightness(), tmp_path / "cache")


def test_embeddings_are_in_the_order_of_the_images_and_timed(dataset):
    seen = []
    embedded = embed_dataset(Brightness(), dataset, progress=lambda *done: seen.append(done))
    expected = np.array([Brightness().embed(image) for image in dataset])
    assert np.array_equal(embedded.embeddings, expected)
    assert embedded.embeddings.dtype == np.float32
    assert (embedded.seconds > 0).all()
    assert embedded.oldest is None
    assert seen == [(i, 6) for i in range(1, 7)]


class BrightnessAtOnce(Brightness):
    """The same, of several images at once."""

    def embed_many(self, images):
        self.calls -= len(images) - 1  # all of them are one
        return np.array([self.embed(image) for image in images])


def test_a_device_takes_images_at_once_those_that_are_not_kept(dataset, tmp_path, monkeypatch):
    one_by_one = embed_dataset(Brightness(), dataset).embeddings
    monkeypatch.setenv("LOOPCLOSE_DEVICE", "cuda")
    recognizer, seen = BrightnessAtOnce(), []
    cache = EmbeddingCache(recognizer, tmp_path / "cache")
    cache.keep(dataset.paths[1], recognizer.embed(dataset[1]), 0.25)
    embedded = embed_dataset(recognizer, dataset, cache, lambda *done: seen.append(done))
    assert np.array_equal(embedded.embeddings, one_by_one)
    assert recognizer.calls == 2  # what was kept, and the others
    assert embedded.seconds[1] == 0.25
    assert len({*embedded.seconds}) == 2
    assert seen == [(6, 6)]
    for path, vector in zip(dataset.paths, one_by_one, strict=True):
        assert np.array_equal(cache.find(path).vector, vector)


def test_on_the_cpu_images_go_one_by_one(dataset):
    recognizer = BrightnessAtOnce()
    embed_dataset(recognizer, dataset)
    assert recognizer.calls == len(dataset)


def test_what_another_device_made_is_not_found(tmp_path, image, monkeypatch):
    EmbeddingCache(Marked(), tmp_path).keep(image, VECTOR, 0.25)
    monkeypatch.setenv("LOOPCLOSE_DEVICE", "cuda")
    assert EmbeddingCache(Marked(), tmp_path).find(image) is None


def test_the_second_time_nothing_is_embedded(dataset, cache, later_run):
    first, second = Brightness(), Brightness()
    fresh = embed_dataset(first, dataset, cache)
    assert embed_dataset(second, dataset, cache).oldest is None
    later_run()
    again = embed_dataset(second, dataset, cache)
    assert (first.calls, second.calls) == (3, 0)  # ref/ has the very images of query/
    assert np.array_equal(fresh.embeddings, again.embeddings)
    assert set(again.seconds) <= set(fresh.seconds)
    assert abs((again.oldest - date.today()).days) <= 1


def test_what_was_done_before_a_stop_is_not_done_again(dataset, cache):
    def stop(done, total):
        if done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        embed_dataset(Brightness(), dataset, cache, stop)
    rest = Brightness()
    embed_dataset(rest, dataset, cache)
    assert rest.calls == 1


def test_what_is_wrong_is_refused_not_kept(dataset, cache):
    with pytest.raises(RecognizerError, match="returned a vector of length"):
        embed_dataset(Brightness(length=3.0), dataset, cache)
    assert cache.find(dataset.paths[0]) is None


def test_a_fingerprint_that_did_not_change_with_the_embeddings_is_noticed(dataset, cache):
    cache.keep(dataset.paths[0], Brightness(size=4).embed(dataset[0]), 0.1)
    with pytest.raises(RecognizerError, match="change the recognizer's fingerprint"):
        embed_dataset(Brightness(), dataset, cache)


def test_an_image_that_is_gone_is_one_line(dataset):
    dataset.paths[2].unlink()
    with pytest.raises(RecognizerError, match="image 2 cannot be read"):
        embed_dataset(Brightness(), dataset)
