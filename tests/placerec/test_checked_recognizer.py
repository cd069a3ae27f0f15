# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys
import threading

import numpy as np
import pytest
import torch

from placerec.checked_recognizer import COSINES, CheckedRecognizer, flaw_in
from placerec.errors import RecognizerError

IMAGE = np.zeros((4, 4, 3), np.uint8)


def test_cosines_agree_with_double_precision_and_never_pass_one():
    rng = np.random.default_rng(0)
    rows = rng.normal(size=(40, 300))
    rows = (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)
    found = COSINES.compare(rows[:7], rows)
    assert found.shape == (7, 40)
    assert found.dtype == np.float32
    assert np.allclose(found, rows[:7].astype(float) @ rows.T.astype(float), atol=1e-6)
    assert found.max() <= 1.0


@pytest.mark.parametrize("size", [3, 513, 20_001])
def test_equal_pairs_tie_wherever_they_stand(size):
    two = np.random.default_rng(size).normal(size=(2, size))
    two = (two / np.linalg.norm(two, axis=1, keepdims=True)).astype(np.float32)
    rows = two[np.arange(67) % 2]
    assert len(np.unique(COSINES.compare(rows[:5], rows[1:]))) <= 3


@pytest.mark.parametrize(
    ("answer", "flaw"),
    [
        (np.zeros((2, 3), np.float32), None),
        ([[1.0, -1.0, 0], [1.0005, 0, 0]], None),
        (np.zeros((3, 2)), "similarities of shape (3, 2), not (queries, references) = (2, 3)"),
        (np.zeros(6), "similarities of shape (6,)"),
        (0.5, "similarities of shape ()"),
        ([[0, np.nan, 0], [np.inf, 0, 0]], "2 of 6 similarities that are NaN or infinite"),
        ([[0, 0, 0], [0, -3.5, 1]], "a similarity of -3.5; it must lie from -1 to 1"),
        (None, "a NoneType that is not an array of numbers|shape ()"),
        ({"a": 1}, "a dict that is not an array of numbers"),
        ([[1, 2], [3]], "a list that is not an array of numbers"),
        (torch.zeros(2, 3, requires_grad=True), "a Tensor that is not an array of numbers"),
    ],
)
def test_what_is_wrong_with_an_answer_is_said(answer, flaw):
    found = flaw_in(answer, (2, 3))
    if flaw is None:
        assert found is None
    else:
        assert any(part in found for part in flaw.split("|"))


def test_there_is_nothing_wrong_with_no_similarities():
    assert flaw_in(np.empty((0, 3), np.float32), (0, 3)) is None


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
def test_bad_answer_is_one_line(answer, told, error_of):
    checked = CheckedRecognizer(Answers(answer), "mine")
    message = error_of(checked.embed, IMAGE)
    assert message.startswith("recognizer 'mine'")
    assert any(part in message for part in told.split("|"))


class AtOnce(Answers):
    """Answers all in one go, and one answer more."""

    def embed_many(self, images):
        return [self.embed(image) for image in images] + self.answers


@pytest.mark.parametrize("kind", [Answers, AtOnce])
def test_many_images_are_checked_as_one_is(kind, error_of):
    good, bad = np.array([0.6, 0.8]), np.array([0.6, 0.9])
    embeddings = CheckedRecognizer(kind(good, good)).embed_many([IMAGE, IMAGE])
    np.testing.assert_allclose(embeddings, [good, good])
    assert [each.dtype for each in embeddings] == [np.float32, np.float32]
    checked = CheckedRecognizer(kind(good, bad), "mine")
    assert "length 1.08167" in error_of(checked.embed_many, [IMAGE, IMAGE])
    failing = CheckedRecognizer(kind(good, RuntimeError("boom")), "mine")
    assert "recognizer 'mine' failed: RuntimeError: boom" in error_of(
        failing.embed_many, [IMAGE, IMAGE]
    )


def test_as_many_embeddings_as_images(error_of):
    checked = CheckedRecognizer(AtOnce(*[np.array([1.0])] * 3))
    assert "3 embeddings of 2 images" in error_of(checked.embed_many, [IMAGE, IMAGE])


def test_one_image_is_embedded_as_in_a_run():
    checked = CheckedRecognizer(AtOnce(*[np.array([1.0])] * 3))
    assert checked.embed_many([IMAGE]) == [[1.0]]
    assert checked.embed_many([]) == []


def test_changing_dimension_is_refused(error_of):
    checked = CheckedRecognizer(Answers(np.array([1.0, 0.0]), np.array([1.0, 0.0, 0.0])))
    checked.embed(IMAGE)
    assert "shape (3,) after (2,)" in error_of(checked.embed, IMAGE)


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


def test_what_compares_itself_may_embed_any_shape_but_always_the_same(error_of):
    shapes = [np.full((3, 4), 5.0), np.full((3, 4), 6.0), np.full(12, 6.0)]
    checked = CheckedRecognizer(Compares(np.zeros((2, 2)), *shapes))
    for expected in shapes[:2]:
        embedding = checked.embed(IMAGE)
        assert embedding.dtype == np.float32
        assert np.array_equal(embedding, expected)
    assert "shape (12,) after (3, 4)" in error_of(checked.embed, IMAGE)


@pytest.mark.parametrize("answer", [np.full((3, 4), np.nan), np.ones((3, 0)), 2.0])
def test_what_compares_itself_embeds_finite_arrays(answer, error_of):
    message = error_of(CheckedRecognizer(Compares(None, answer)).embed, IMAGE)
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
def test_a_misbehaving_compare_is_one_line(answer, told, error_of):
    checked = CheckedRecognizer(Compares(answer), "mine")
    message = error_of(checked.compare, ROWS, ROWS)
    assert message.startswith("recognizer 'mine'")
    assert any(part in message for part in told.split("|"))


class Reranks(Answers):
    """A recognizer that looks at images a second time, and gives the given answer."""

    def __init__(self, answer):
        super().__init__()
        self.answer = answer

    def rerank(self, query, candidates):
        if isinstance(self.answer, Exception):
            raise self.answer
        return self.answer


def test_scores_of_a_second_look_are_passed_on(error_of):
    checked = CheckedRecognizer(Reranks([0, 1]))
    assert checked.can_rerank
    found = checked.rerank(IMAGE, [IMAGE, IMAGE])
    assert found.dtype == np.float64 and found.tolist() == [0.0, 1.0]
    without = CheckedRecognizer(Answers(), "mine")
    assert not without.can_rerank
    assert "no method rerank(query, candidates)" in error_of(without.rerank, IMAGE, [])


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        ([0.5], "scores of shape (1,), not (candidates,) = (2,)"),
        ([[0.5, 0.5]], "scores of shape (1, 2)"),
        ([0.5, np.nan], "a score of nan; it must lie from 0 to 1"),
        ([-0.1, 0.5], "a score of -0.1"),
        ([0.5, np.inf], "a score of inf"),
        (["much", "little"], "not an array of numbers"),
        (None, "not an array of numbers|shape ()"),
        (RuntimeError("out of\nmemory"), "failed to rerank: RuntimeError: out of memory"),
    ],
)
def test_a_misbehaving_rerank_is_one_line(answer, told, error_of):
    checked = CheckedRecognizer(Reranks(answer), "mine")
    message = error_of(checked.rerank, IMAGE, [IMAGE, IMAGE])
    assert message.startswith("recognizer 'mine'")
    assert any(part in message for part in told.split("|"))


def test_rerank_must_be_a_method(error_of):
    recognizer = Answers()
    recognizer.rerank = 0.5
    assert "rerank that is no method" in error_of(CheckedRecognizer, recognizer)


def test_how_far_it_looks_back(error_of):
    assert CheckedRecognizer(Compares(None)).looks_back == 32
    assert CheckedRecognizer(Compares(None, looks_back=0)).looks_back == 0
    for wrong in (-1, 1.5, "all", None):
        assert "looks_back" in error_of(CheckedRecognizer, Compares(None, looks_back=wrong))


def test_compare_must_be_a_method(error_of):
    recognizer = Answers()
    recognizer.compare = 0.5
    assert "compare that is no method" in error_of(CheckedRecognizer, recognizer)


@pytest.mark.parametrize("threshold", [np.nan, 1.5, -2, np.inf, None, "high"])
def test_threshold_must_be_a_cosine(threshold, error_of):
    message = error_of(lambda: CheckedRecognizer(Answers(min_similarity=threshold)))
    assert "min_similarity" in message
    assert "-1 to 1" in message


class Stops:
    """A recognizer that does something else than answer."""

    min_similarity = 0.5

    def __init__(self, step):
        self.step = step

    def embed(self, image):
        self.step()
        return np.array([1.0, 0.0])


@pytest.mark.parametrize("limit_s", [None, 30.0])
@pytest.mark.parametrize("code", [0, "bye"])
def test_a_recognizer_does_not_end_the_command(limit_s, code):
    checked = CheckedRecognizer(Stops(lambda: sys.exit(code)), limit_s=limit_s)
    with pytest.raises(RecognizerError, match=rf"'Stops' failed: SystemExit: {code}"):
        checked.embed(IMAGE)


def test_what_only_signals_raise_is_a_failure_where_a_recognizer_raises_it():
    def interrupt():
        raise KeyboardInterrupt

    checked = CheckedRecognizer(Stops(interrupt), limit_s=30.0)
    with pytest.raises(RecognizerError, match="'Stops' failed: RuntimeError: KeyboardInterrupt"):
        checked.embed(IMAGE)


def test_a_recognizer_that_never_answers_is_given_up():
    forever = threading.Event()
    checked = CheckedRecognizer(Stops(forever.wait), limit_s=0.05)
    for _ in range(2):  # the second time nobody waits
        with pytest.raises(RecognizerError, match=r"'Stops' failed: no answer within 0\.05 s"):
            checked.embed(IMAGE)
    forever.set()
    rows = np.eye(2, dtype=np.float32)
    assert np.array_equal(checked.compare(rows, rows), rows)  # cosines do not need it


def test_a_recognizer_that_never_answers_does_not_hold_the_process():
    code = (
        "import numpy as np, time\n"
        "from placerec.checked_recognizer import CheckedRecognizer\n"
        "class Sleeps:\n"
        "    min_similarity = 0.5\n"
        "    def embed(self, image):\n"
        "        time.sleep(600)\n"
        "try:\n"
        "    CheckedRecognizer(Sleeps(), limit_s=0.05).embed(np.zeros((4, 4, 3), np.uint8))\n"
        "except Exception as error:\n"
        "    print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert done.stdout == "recognizer 'Sleeps' failed: no answer within 0.05 s\n"


def test_a_member_that_fails_is_told():
    class Odd:
        embed = None

        @property
        def min_similarity(self):
            raise RuntimeError("not yet")

    with pytest.raises(RecognizerError, match="does not tell its members: RuntimeError: not yet"):
        CheckedRecognizer(Odd())
