# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace
from importlib import import_module
from importlib.metadata import EntryPoint

import numpy as np
import pytest
import safetensors.torch
import torch
from safetensors import safe_open
from safetensors.numpy import save

from placerec import recognizer
from placerec.errors import RecognizerError
from placerec.recognizer import load
from placerec.recognizers import fitted_file
from placerec.recognizers.fitted_file import (
    METADATA_KEY,
    Fitted,
    open_recognizer,
    owner_of,
    read_fitted,
    write_fitted,
)

ARRAYS = {"b": np.arange(6, dtype=np.uint8).reshape(2, 3), "a": np.ones(2, np.float16)}
LEARNED = Fitted(ARRAYS, {"layer": "a layer", "eye": "left"}, ("walk",), 0.25)


def test_what_was_written_is_read_back(tmp_path):
    write_fitted(tmp_path / "w.safetensors", "mine", LEARNED)
    found = read_fitted(tmp_path / "w.safetensors", "mine")
    assert replace(found, arrays={}) == replace(LEARNED, arrays={})
    assert found.fingerprint == LEARNED.fingerprint and found.source == "walk"
    assert found.arrays.keys() == ARRAYS.keys()
    for name, array in found.arrays.items():
        assert array.dtype == ARRAYS[name].dtype
        np.testing.assert_array_equal(array, ARRAYS[name])


def test_the_same_is_the_same_bytes(tmp_path):
    files = [tmp_path / f"{i}.safetensors" for i in range(2)]
    turned = Fitted(
        dict(reversed(ARRAYS.items())), dict(reversed(LEARNED.facts.items())), ("walk",), 0.25
    )
    write_fitted(files[0], "mine", LEARNED)
    write_fitted(files[1], "mine", turned)
    assert files[0].read_bytes() == files[1].read_bytes()
    assert turned.fingerprint == LEARNED.fingerprint


@pytest.mark.parametrize(
    "other",
    [
        replace(LEARNED, facts={}),
        replace(LEARNED, arrays=ARRAYS | {"a": np.ones(2, np.float32)}),
        replace(LEARNED, arrays=ARRAYS | {"b": ARRAYS["b"].reshape(3, 2)}),
        replace(LEARNED, arrays=ARRAYS | {"b": ARRAYS["b"] + np.uint8(1)}),
    ],
)
def test_the_fingerprint_is_of_what_embeddings_depend_on(other):
    assert other.fingerprint != LEARNED.fingerprint
    assert replace(LEARNED, min_similarity=0.5, trained_on=()).fingerprint == LEARNED.fingerprint


@pytest.mark.parametrize(
    ("content", "what"),
    [(None, "there is no file"), (b"oh", "not a whole file"), ("others", "is of mine, not of")],
)
def test_a_file_that_cannot_be_used_is_one_line(tmp_path, content, what):
    path = tmp_path / "w.safetensors"
    if content == "others":
        write_fitted(path, "mine", LEARNED)
    elif content:
        path.write_bytes(content)
    with pytest.raises(RecognizerError, match=what) as caught:
        read_fitted(path, "yours")
    assert "\n" not in str(caught.value) and str(caught.value).endswith(str(path))


class Mine:
    min_similarity = 0.0

    def __init__(self, path):
        self.fitted = read_fitted(path, "mine")

    def embed(self, image):
        return np.ones(1, np.float32)


def test_a_file_names_its_recognizer(tmp_path, monkeypatch):
    class Entry:
        def load(self):
            return Mine

    path = tmp_path / "w.safetensors"
    write_fitted(path, "mine", LEARNED)
    monkeypatch.setattr(fitted_file, "find", {"mine": Entry()}.get)
    assert owner_of(path) == "mine"
    recognizer = load(str(path))
    assert isinstance(recognizer, Mine) and recognizer.fitted.trained_on == ("walk",)


def test_a_file_cannot_name_code_to_run(tmp_path):
    path = tmp_path / "w.safetensors"
    with pytest.raises(RecognizerError, match="recognizer = 'os:system' cannot be kept"):
        write_fitted(path, "os:system", LEARNED)
    description = '{"recognizer": "os:getcwd", "min_similarity": 0, "trained_on": [], "facts": {}}'
    path.write_bytes(save({}, {METADATA_KEY: description}))
    assert owner_of(path) is None
    path.write_bytes(save({}, {METADATA_KEY: description.replace(":get", "-get")}))
    assert owner_of(path) == "os-getcwd"


def test_any_other_file_is_taken_for_a_network(tmp_path):
    path = tmp_path / "w.safetensors"
    path.write_bytes(b"oh")
    with pytest.raises(RecognizerError, match="pickle is never opened"):
        open_recognizer(path)


@pytest.mark.parametrize(
    ("owner", "what"),
    [
        ("gradients", "says it is of gradients, and does not fit: TypeError"),  # takes no file
        ("bag-of-words", "says it is of bag-of-words, and does not fit: KeyError: 'rarity'"),
        ("mine", "recognizer of w.safetensors cannot be imported: ModuleNotFoundError"),
        ("nobody", "there is no recognizer 'nobody'"),
    ],
)
def test_a_file_that_names_something_strange_is_one_line(tmp_path, monkeypatch, owner, what):
    def find(name):
        if name != "mine":
            return recognizer.find(name)
        return EntryPoint("mine", "no_such_module:Mine", recognizer.ENTRY_POINT_GROUP)

    monkeypatch.setattr(fitted_file, "find", find)
    write_fitted(tmp_path / "w.safetensors", owner, LEARNED)
    with pytest.raises(RecognizerError, match=what) as caught:
        load(str(tmp_path / "w.safetensors"))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("teacher", ["numpy", "ml_dtypes"])  # the second comes with onnx
def test_numbers_of_a_kind_that_numpy_lacks_are_one_line(tmp_path, teacher):
    import_module(teacher)
    path = tmp_path / "w.safetensors"
    write_fitted(path, "mine", LEARNED)
    with safe_open(path, framework="np") as file:
        metadata = file.metadata()
    safetensors.torch.save_file({"a": torch.ones(2, dtype=torch.bfloat16)}, path, metadata)
    with pytest.raises(RecognizerError, match="not a whole file of mine"):
        read_fitted(path, "mine")
