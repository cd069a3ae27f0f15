# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.baselines.fitted import Fitted, fitted_folder, read_fitted, write_fitted
from placerec.recognizer import RecognizerError

MEAN = np.array([[0.5, -2.0], [0.25, 3.0]], np.float32)
FITTED = Fitted({"mean": MEAN}, {"layer": "a layer"}, "a building")


@pytest.fixture(autouse=True)
def nothing_here(machine):
    return machine


def test_what_was_written_is_read_back():
    path = write_fitted("mine", FITTED)
    assert path == fitted_folder() / "mine.safetensors"
    found = read_fitted("mine")
    assert found.arrays["mean"].dtype == np.float32
    assert np.array_equal(found.arrays["mean"], MEAN)
    assert (found.facts, found.data) == (FITTED.facts, "a building")
    assert found.fingerprint == FITTED.fingerprint


def test_the_same_is_the_same_bytes(tmp_path):
    first, second = (write_fitted("mine", FITTED, tmp_path / str(i)) for i in range(2))
    assert first.read_bytes() == second.read_bytes()


@pytest.mark.parametrize(
    "other",
    [Fitted({"mean": MEAN + 1}, FITTED.facts), Fitted({"mean": MEAN}, {"layer": "another"})],
)
def test_the_fingerprint_is_of_what_matters(other):
    assert other.fingerprint != FITTED.fingerprint
    assert Fitted(FITTED.arrays, FITTED.facts, "other images").fingerprint == FITTED.fingerprint


def test_the_users_own_goes_before_what_is_shipped(tmp_path):
    write_fitted("mine", Fitted({"mean": MEAN}, {}, "shipped"), tmp_path)
    assert read_fitted("mine", tmp_path).data == "shipped"
    write_fitted("mine", FITTED)
    assert read_fitted("mine", tmp_path).data == "a building"


def test_where_there_is_none_it_says_what_to_do():
    with pytest.raises(RecognizerError, match="placerec fit mine FOLDER"):
        read_fitted("mine")


@pytest.mark.parametrize(
    "damage", [lambda content: b"", lambda content: content[:-3], lambda content: b"x" * 99]
)
def test_a_damaged_file_is_refused_in_one_line(damage):
    path = write_fitted("mine", FITTED)
    path.write_bytes(damage(path.read_bytes()))
    with pytest.raises(RecognizerError, match="placerec fit") as caught:
        read_fitted("mine")
    assert str(path) in str(caught.value) and "\n" not in str(caught.value)
