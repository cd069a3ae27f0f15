# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.errors import RecognizerError
from placerec.places.rows import check_embeddings, checked_rows, conditions

ROW = np.eye(4, dtype=np.float32)[:1]


def test_rows_are_of_the_types_that_are_stored():
    rows = checked_rows("a", [7], np.array([3], np.uint16), ROW)
    assert (rows.keyframes.dtype, rows.times_s.dtype) == (np.int64, np.float64)
    assert (rows.keyframes.tolist(), rows.times_s.tolist()) == ([7], [3.0])


@pytest.mark.parametrize(
    ("changed", "line"),
    [
        ({"session": ""}, "the name of a session has 0 characters"),
        ({"session": "n" * 201}, "the name of a session has 201 characters"),
        ({"session": "a\nb"}, "give it a name that can be shown"),
        ({"session": 7}, "give it a name that can be shown"),
        ({"keyframes": [1, 2]}, r"1 embeddings have keyframes of shape \(2,\)"),
        ({"times_s": [[1.0]]}, r"times of shape \(1, 1\)"),
        ({"keyframes": [-1]}, "must be whole, 0 or more"),
        ({"keyframes": [1.0]}, "must be whole, 0 or more"),
        ({"keyframes": np.array([2**63], np.uint64)}, "must be whole, 0 or more"),
        ({"times_s": [np.inf]}, "must be finite numbers of seconds"),
        ({"times_s": ["noon"]}, "must be finite numbers of seconds"),
    ],
)
def test_other_rows_are_refused_in_one_line(changed, line):
    good = {"session": "a", "keyframes": [1], "times_s": [1.0], "embeddings": ROW}
    with pytest.raises(RecognizerError, match=line):
        checked_rows(**{**good, **changed})


@pytest.mark.parametrize(
    ("embeddings", "line"),
    [
        (ROW.astype(float), "are float64; a store takes arrays of float32"),
        (ROW.tolist(), "are list; a store takes arrays of float32"),
        (ROW[0], r"have shape \(4,\), not \(N, D\)"),
        (ROW[:, :0], r"have shape \(1, 0\), not \(N, D\)"),
        (ROW * np.float32(np.nan), "1 of 1 embeddings are not of unit length.* has nan"),
        (np.concatenate([ROW, 2 * ROW]), "1 of 2 embeddings are not of unit length.* has 2"),
    ],
)
def test_what_no_checked_recognizer_makes_is_refused(embeddings, line):
    with pytest.raises(RecognizerError, match=line):
        check_embeddings(embeddings, 2)


def test_conditions_are_quoted():
    assert conditions(None, None) == [None]
    assert conditions([], None) == ["false"]
    assert conditions(["it's"], None) == ["session IN ('it''s')"]
    others, own = conditions(None, ("it's", 2))
    assert others == "NOT session = 'it''s'"
    assert own == "session = 'it''s' AND time_s < 2.0"
    assert conditions(["a", "b"], ("a", 0.5)) == [
        "session IN ('a', 'b') AND NOT session = 'a'",
        "session IN ('a', 'b') AND session = 'a' AND time_s < 0.5",
    ]
    with pytest.raises(RecognizerError, match="recent places are those since nan"):
        conditions(None, ("a", float("nan")))
