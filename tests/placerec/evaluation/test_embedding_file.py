# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.errors import RecognizerError
from placerec.evaluation.embedding_file import (
    Embedded,
    EmbeddingFile,
    embedded_csv,
    embedded_table,
    read_embedding_file,
    write_embedding_file,
)

MADE = EmbeddingFile("/a", "sha256:b", ("/a/0.png", "/a/é.png"), 1, np.eye(2, 3, dtype=np.float32))


@pytest.mark.parametrize("timestamps_s", [None, np.array([0.5, 1.0])])
def test_what_was_written_is_read_and_is_plain_arrays(tmp_path, timestamps_s):
    made = EmbeddingFile(*list(vars(MADE).values())[:5], timestamps_s)
    write_embedding_file(made, tmp_path / "a.npz")
    found = read_embedding_file(tmp_path / "a.npz")
    for name, value in vars(made).items():
        assert np.array_equal(getattr(found, name), value), name
    with np.load(tmp_path / "a.npz") as arrays:
        assert arrays["embeddings"].dtype == np.float32
        assert ("timestamps_s" in arrays) == (timestamps_s is not None)
    before = (tmp_path / "a.npz").read_bytes()
    write_embedding_file(made, tmp_path / "a.npz")
    assert (tmp_path / "a.npz").read_bytes() == before


def test_what_is_damaged_or_something_else_is_one_line(tmp_path):
    path = tmp_path / "a.npz"
    write_embedding_file(MADE, path)
    whole = path.read_bytes()
    np.savez(tmp_path / "other.npz", source="a")
    for content in (b"", whole[:-30], (tmp_path / "other.npz").read_bytes()):
        path.write_bytes(content)
        with pytest.raises(RecognizerError, match="not a file of embeddings, or damaged"):
            read_embedding_file(path)


def test_the_tables_tell_counts_and_failures():
    rows = [Embedded("good", 7, 1, (4, 2)), Embedded("bad", why="no | such\tfolder")]
    assert embedded_csv(rows).splitlines() == [
        "data,images,skipped,values,failure",
        "good,7,1,4 x 2,",
        "bad,,,,no | such\\tfolder",
    ]
    assert embedded_table(rows).splitlines()[2:] == [
        "| good |      7 |       1 |  4 x 2 |",
        "| bad  | failed: no \\| such\tfolder |",
    ]
