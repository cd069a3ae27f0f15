# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from pydantic import ValidationError
from safetensors.numpy import save

from placerec import fitted_file
from placerec.fitted_file import (
    METADATA_KEY,
    Fitted,
    hash_arrays,
    open_recognizer,
    read_fitted,
    write_fitted,
)
from placerec.recognizer import RecognizerError, load

ARRAYS = {"b": np.arange(6, dtype=np.uint8).reshape(2, 3), "a": np.ones(2, np.float16)}
MINE = Fitted(recognizer="mine", min_similarity=0.25, trained_on=("walk",))


def test_what_was_written_is_read_back(tmp_path):
    write_fitted(tmp_path / "w.safetensors", MINE, ARRAYS)
    fitted, arrays = read_fitted(tmp_path / "w.safetensors", "mine")
    assert fitted == MINE
    assert arrays.keys() == ARRAYS.keys()
    for name, array in arrays.items():
        assert array.dtype == ARRAYS[name].dtype
        np.testing.assert_array_equal(array, ARRAYS[name])


def test_the_same_arrays_are_the_same_bytes(tmp_path):
    files = [tmp_path / f"{i}.safetensors" for i in range(2)]
    write_fitted(files[0], MINE, ARRAYS)
    write_fitted(files[1], MINE, dict(reversed(ARRAYS.items())))
    assert files[0].read_bytes() == files[1].read_bytes()


@pytest.mark.parametrize(
    ("content", "what"),
    [(None, "there is no file"), (b"oh", "not a whole file"), ("others", "is of mine, not of")],
)
def test_a_file_that_cannot_be_used_is_one_line_with_the_remedy(tmp_path, content, what):
    path = tmp_path / "w.safetensors"
    if content == "others":
        write_fitted(path, MINE, ARRAYS)
    elif content:
        path.write_bytes(content)
    with pytest.raises(RecognizerError, match=what) as caught:
        read_fitted(path, "yours")
    assert "\n" not in str(caught.value) and str(caught.value).endswith(str(path))


class Mine:
    min_similarity = 0.0

    def __init__(self, path):
        self.fitted, self.arrays = read_fitted(path, "mine")

    def embed(self, image):
        return np.ones(1, np.float32)


def test_a_file_names_its_recognizer(tmp_path, monkeypatch):
    class Entry:
        def load(self):
            return Mine

    path = tmp_path / "w.safetensors"
    write_fitted(path, MINE, ARRAYS)
    monkeypatch.setattr(fitted_file, "find", {"mine": Entry()}.get)
    assert isinstance(load(str(path)), Mine)


def test_a_file_cannot_name_code_to_run(tmp_path):
    with pytest.raises(ValidationError):
        Fitted(recognizer="os:system", min_similarity=0.0)
    metadata = {METADATA_KEY: '{"recognizer": "os:getcwd", "min_similarity": 0}'}
    (tmp_path / "w.safetensors").write_bytes(save({}, metadata))
    with pytest.raises(RecognizerError, match="not of a place network"):
        load(str(tmp_path / "w.safetensors"))


def test_any_other_file_is_taken_for_a_network(tmp_path):
    path = tmp_path / "w.safetensors"
    path.write_bytes(b"oh")
    with pytest.raises(RecognizerError, match="pickle is never opened"):
        open_recognizer(path)


def test_a_hash_changes_with_what_it_is_of():
    hashes = {
        hash_arrays(ARRAYS),
        hash_arrays(ARRAYS, 1),
        hash_arrays(ARRAYS | {"a": np.ones(2, np.float32)}),
        hash_arrays(ARRAYS | {"b": ARRAYS["b"].reshape(3, 2)}),
        hash_arrays(ARRAYS | {"b": ARRAYS["b"] + np.uint8(1)}),
    }
    assert len(hashes) == 5
    assert hash_arrays(dict(reversed(ARRAYS.items()))) in hashes
