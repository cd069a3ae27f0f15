# SPDX-License-Identifier: Apache-2.0
from datetime import date

import numpy as np
import pytest

from placerec.datasets import open_dataset
from placerec.errors import RecognizerError
from placerec.evaluation.embeddings import EmbeddingCache, embed_dataset


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
