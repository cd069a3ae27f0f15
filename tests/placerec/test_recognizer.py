# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

import numpy as np
import pytest

from placerec.checked_recognizer import CheckedRecognizer
from placerec.errors import RecognizerError
from placerec.recognizer import PlaceRecognizer, available, load

IMAGE = np.zeros((4, 4, 3), np.uint8)

PLUG_IN = """
class Good:
    min_similarity = 0.5
    def embed(self, image):
        return image

def make():
    return Good()

class NoThreshold:
    min_similarity: float
    def embed(self, image):
        return image

class NoEmbed:
    min_similarity = 0.5

class Fails(Good):
    def __init__(self):
        raise OSError("no weights\\nat all")

number = 3
"""


class Answers:
    """A recognizer that returns the given answers one after the other."""

    def __init__(self, *answers, min_similarity=0.5):
        self.answers = list(answers)
        self.min_similarity = min_similarity

    def embed(self, image):
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


@pytest.fixture
def packages(tmp_path: Path, monkeypatch):
    """Install distributions of the given names and entry points; return the installer."""
    monkeypatch.setattr(sys, "path", [str(tmp_path), *_without_loopclose()])
    monkeypatch.delitem(sys.modules, "plug_in", raising=False)
    (tmp_path / "plug_in.py").write_text(PLUG_IN)

    def install(distribution: str, **entries: str) -> None:
        folder = tmp_path / f"{distribution}-1.0.dist-info"
        folder.mkdir()
        (folder / "METADATA").write_text(f"Name: {distribution}\nVersion: 1.0\n")
        lines = ["[placerec.recognizers]", *(f"{k} = {v}" for k, v in entries.items())]
        (folder / "entry_points.txt").write_text("\n".join(lines))

    yield install
    sys.modules.pop("plug_in", None)


def _without_loopclose() -> list[str]:
    # The installed built-ins would otherwise be listed beside those of the test.
    return [p for p in sys.path if not list(Path(p or ".").glob("loopclose-*.dist-info"))]


def _message(call, *arguments) -> str:
    with pytest.raises(RecognizerError) as caught:
        call(*arguments)
    message = str(caught.value)
    assert "\n" not in message
    return message


def test_available_lists_names_without_importing_them(packages):
    packages("theirs", zebra="plug_in:Good", apple="does_not_exist:X")
    assert available() == ("apple", "zebra")
    assert "plug_in" not in sys.modules


@pytest.mark.parametrize("target", ["plug_in:Good", "plug_in:make"])
def test_load_takes_a_class_or_a_factory(packages, target):
    packages("theirs", mine=target, broken="does_not_exist:X")
    assert load("mine").min_similarity == 0.5
    assert isinstance(load(target), PlaceRecognizer)


def test_unknown_name_lists_what_is_installed_and_hints(packages):
    packages("theirs", apple="plug_in:Good", zebra="plug_in:Good")
    message = _message(load, "aple")
    assert "did you mean 'apple'" in message
    assert "installed: apple, zebra" in message


def test_one_name_claimed_twice_names_both(packages):
    packages("first-one", mine="plug_in:Good")
    packages("second-one", mine="plug_in:Good")
    message = _message(load, "mine")
    assert "first-one and second-one" in message


@pytest.mark.parametrize(
    ("target", "told"),
    [
        ("does_not_exist:X", "cannot be imported: ModuleNotFoundError"),
        ("plug_in:Missing", "cannot be imported: AttributeError"),
        ("plug_in:Fails", "cannot be constructed: OSError: no weights at all"),
        ("plug_in:NoThreshold", "no attribute min_similarity"),
        ("plug_in:NoEmbed", "no method embed"),
        ("plug_in:number", "is a int"),
    ],
)
def test_broken_plug_in_is_one_line_that_names_it(packages, target, told):
    packages("theirs", mine=target)
    message = _message(load, "mine")
    assert message.startswith(f"recognizer 'mine' ({target})")
    assert told in message
    assert told in _message(load, target)


@pytest.mark.parametrize("name", ["a:b:c", ":X", "plug_in:", "plug in:X"])
def test_malformed_class_path(name):
    assert "package.module:ClassName" in _message(load, name)


def test_checked_answer_is_float32_and_exactly_unit():
    checked = CheckedRecognizer(Answers([0.6, 0.8 + 5e-4]))
    embedding = checked.embed(IMAGE)
    assert embedding.dtype == np.float32
    assert np.linalg.norm(embedding.astype(float)) == pytest.approx(1.0, abs=1e-7)


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (np.array([np.nan, 1.0, np.inf]), "2 of 3 values that are NaN or infinite"),
        (np.ones((1, 4)) / 2, "shape (1, 4)"),
        (np.float32(1.0), "shape ()"),
        (np.empty(0), "shape (0,)"),
        (np.zeros(4), "length 0"),
        (np.ones(4), "length 2"),
        ("text", "a str that is not an array of numbers"),
        (None, "NaN or infinite|shape"),
        ({"a": 1}, "a dict"),
        (RuntimeError("out of\nmemory"), "failed: RuntimeError: out of memory"),
    ],
)
def test_bad_answer_is_one_line(answer, told):
    checked = CheckedRecognizer(Answers(answer), "mine")
    message = _message(checked.embed, IMAGE)
    assert message.startswith("recognizer 'mine'")
    assert any(part in message for part in told.split("|"))


def test_changing_dimension_is_refused():
    checked = CheckedRecognizer(Answers(np.array([1.0, 0.0]), np.array([1.0, 0.0, 0.0])))
    checked.embed(IMAGE)
    assert "shape (3,) after (2,)" in _message(checked.embed, IMAGE)


def test_failure_keeps_its_cause():
    cause = RuntimeError("boom")
    with pytest.raises(RecognizerError) as caught:
        CheckedRecognizer(Answers(cause)).embed(IMAGE)
    assert caught.value.__cause__ is cause


class Compares(Answers):
    """A recognizer that compares its embeddings itself, and gives the given answer."""

    def __init__(self, answer, *embeddings, **members):
        super().__init__(*embeddings)
        self.answer = answer
        vars(self).update(members)

    def compare(self, queries, references):
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


ROWS = np.ones((2, 3, 4), np.float32)


def test_what_compares_itself_may_embed_any_shape_but_always_the_same():
    shapes = [np.full((3, 4), 5.0), np.full((3, 4), 6.0), np.full(12, 6.0)]
    checked = CheckedRecognizer(Compares(np.zeros((2, 2)), *shapes))
    for expected in shapes[:2]:
        embedding = checked.embed(IMAGE)
        assert embedding.dtype == np.float32
        assert np.array_equal(embedding, expected)
    assert "shape (12,) after (3, 4)" in _message(checked.embed, IMAGE)


@pytest.mark.parametrize("answer", [np.full((3, 4), np.nan), np.ones((3, 0)), 2.0])
def test_what_compares_itself_embeds_finite_arrays(answer):
    message = _message(CheckedRecognizer(Compares(None, answer)).embed, IMAGE)
    assert "12 of 12 values" in message or "an array of shape" in message


def test_similarities_are_float32_within_their_bounds():
    found = CheckedRecognizer(Compares([[1.0005, 0.5], [0.5, -1]])).compare(ROWS, ROWS)
    assert found.dtype == np.float32
    assert found.tolist() == [[1.0, 0.5], [0.5, -1.0]]


def test_without_compare_it_is_the_cosine():
    rows = np.float32([[1.0, 0.0], [0.6, 0.8]])
    checked = CheckedRecognizer(Answers())
    assert checked.compare(rows, rows) == pytest.approx(np.array([[1.0, 0.6], [0.6, 1.0]]))
    assert checked.looks_back == 0


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (np.zeros((2, 3)), "shape (2, 3), not (queries, references) = (2, 2)"),
        ([[np.nan, 0], [0, 1]], "1 of 4 similarities that are NaN or infinite"),
        ([[40.0, 0], [0, 1]], "a similarity of 40"),
        (None, "not an array of numbers|shape ()"),
        (RuntimeError("out of\nmemory"), "failed to compare: RuntimeError: out of memory"),
    ],
)
def test_a_misbehaving_compare_is_one_line(answer, told):
    checked = CheckedRecognizer(Compares(answer), "mine")
    message = _message(checked.compare, ROWS, ROWS)
    assert message.startswith("recognizer 'mine'")
    assert any(part in message for part in told.split("|"))


def test_how_far_it_looks_back():
    assert CheckedRecognizer(Compares(None)).looks_back == 32
    assert CheckedRecognizer(Compares(None, looks_back=0)).looks_back == 0
    for wrong in (-1, 1.5, "all", None):
        assert "looks_back" in _message(CheckedRecognizer, Compares(None, looks_back=wrong))


def test_compare_must_be_a_method():
    recognizer = Answers()
    recognizer.compare = 0.5
    assert "compare that is no method" in _message(CheckedRecognizer, recognizer)


@pytest.mark.parametrize("threshold", [np.nan, 1.5, -2, np.inf, None, "high"])
def test_threshold_must_be_a_cosine(threshold):
    message = _message(lambda: CheckedRecognizer(Answers(min_similarity=threshold)))
    assert "min_similarity" in message
    assert "-1 to 1" in message
