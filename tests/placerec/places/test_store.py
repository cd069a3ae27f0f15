# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from placerec import LoopcloseError, PlaceStore, RecognizerError, load
from placerec.places.index import PlaceIndex

ROOT = Path(__file__).parents[3]
EXACT_UP_TO = "placerec.places.store.EXACT_UP_TO"
WRITE = """
import sys
import numpy as np
from placerec import PlaceStore

class Named:
    fingerprint, min_similarity = "version 1", 0.5
    def embed(self, image): ...

store = PlaceStore(sys.argv[1], Named())
print("ready", flush=True)
for k in range(int(sys.argv[3])):
    row = np.eye(16, dtype=np.float32)[[k % 16, 0]]
    store.add(sys.argv[2], [2 * k, 2 * k + 1], [k, k], row)
    print(k + 1, flush=True)
"""


def writer(folder: Path, session: str, batches: int) -> "subprocess.Popen[str]":
    command = [sys.executable, "-c", WRITE, str(folder), session, str(batches)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT)


@pytest.mark.parametrize("is_large", [False, True])
def test_answers_are_those_of_an_index_to_the_last_bit(opened, unit, monkeypatch, is_large):
    """A large store then looks at all places exactly that its index finds."""
    store, index, rows = opened(), PlaceIndex(), unit(300)
    for k in range(3):
        store.add(f"s{k}", range(100), np.arange(100) / 2, rows[100 * k : 100 * k + 100])
    for row in rows:
        index.add(row)
    if is_large:
        monkeypatch.setattr(EXACT_UP_TO, 99)
        monkeypatch.setattr("placerec.places.table._REFINED", 300)
        store.tidy()
    for query in unit(5, seed=1):
        ids, similarities = index.query(query, 7)
        found = store.query(query, 7)
        assert [(each.session, each.keyframe) for each in found] == [
            (f"s{k // 100}", k % 100) for k in ids
        ]
        assert [each.time_s for each in found] == (ids % 100 / 2).tolist()
        assert np.array([each.similarity for each in found], np.float32).tobytes() == (
            similarities.tobytes()
        )


@pytest.mark.parametrize("recent", [None, ("d", 1.0)])
def test_equal_places_are_in_the_order_of_their_names_however_many_there_are(opened, unit, recent):
    store, row = opened(), unit(1)
    store.add("d", [0], [0.0], -row)
    for session in ("c", "a", "b"):
        store.add(session, range(19, -1, -1), np.zeros(20), np.repeat(row, 20, axis=0))
    found = store.query(row[0], 21, recent=recent)
    assert [(each.session, each.keyframe) for each in found] == [
        *(("a", k) for k in range(20)),
        ("b", 0),
    ]


def test_some_sessions_are_asked_and_the_own_recent_past_is_left_out(opened, unit):
    store, row = opened(), unit(1)
    for session in ("it's me", "b", "c"):
        store.add(session, [0, 1, 2], [10.0, 20.0, 30.0], np.repeat(row, 3, axis=0))

    def seen(**asked):
        return [(each.session, each.keyframe) for each in store.query(row[0], 9, **asked)]

    assert seen(sessions=["c", "nobody"]) == [("c", 0), ("c", 1), ("c", 2)]
    assert seen(sessions=["it's me"], recent=("it's me", 20.0)) == [("it's me", 0)]
    assert len(seen(recent=("it's me", 20.0))) == 7
    assert seen(sessions=[]) == []
    assert store.query(row[0], 0) == ()


def test_new_places_are_found_before_and_after_tidying_a_large_store(opened, unit, monkeypatch):
    monkeypatch.setattr(EXACT_UP_TO, 50)
    store, rows = opened(), unit(400)
    for k in range(4):
        store.add(f"s{k}", range(100), np.arange(100.0), rows[100 * k : 100 * k + 100])
        (before,) = store.query(rows[100 * k + 7], 1)
        store.tidy()
        (after,) = store.query(rows[100 * k + 7], 1)
        assert before == after
        assert (after.session, after.keyframe) == (f"s{k}", 7)
    assert len(store) == 400
    (found,) = store.query(rows[7], 1, recent=("s1", 0.0), sessions=["s0", "s1"])
    assert found.session == "s0"


def test_only_the_cells_that_are_most_alike_are_looked_into(opened, unit, monkeypatch):
    monkeypatch.setattr(EXACT_UP_TO, 50)
    monkeypatch.setattr("placerec.places.table._PROBES", 1)
    monkeypatch.setattr("placerec.places.table._REFINED", 400)
    store, rows, queries = opened(), unit(400), unit(20, seed=1)
    store.add("a", range(400), np.arange(400.0), rows)

    def first():
        return [store.query(query, 1)[0].keyframe for query in queries]

    exact = np.argmax(queries @ rows.T, axis=1).tolist()
    assert first() == exact
    store.tidy()
    assert first() != exact


def test_all_that_is_wanted_is_found_where_the_cells_most_alike_lack_it(opened, unit, monkeypatch):
    monkeypatch.setattr(EXACT_UP_TO, 50)
    monkeypatch.setattr("placerec.places.table._PROBES", 1)
    store, noise = opened(), 0.1 * unit(200)
    for session, at in (("near", 0), ("far", 1)):
        rows = np.eye(16, dtype=np.float32)[at] + noise
        rows = rows / np.linalg.norm(rows, axis=1, keepdims=True)
        store.add(session, range(200), np.arange(200.0), rows.astype(np.float32))
    store.tidy()
    query = np.eye(16, dtype=np.float32)[0]
    assert {each.session for each in store.query(query, 5)} == {"near"}
    assert [each.session for each in store.query(query, 5, sessions=["far"])] == 5 * ["far"]


def test_the_own_recent_past_is_left_out_of_a_large_store_and_nothing_else(
    opened, unit, monkeypatch
):
    monkeypatch.setattr(EXACT_UP_TO, 50)
    monkeypatch.setattr("placerec.places.table._REFINED", 300)
    store, rows = opened(), unit(300)
    for k, session in enumerate("abc"):
        store.add(session, range(100), np.arange(100.0), rows[100 * k : 100 * k + 100])
    store.tidy()
    looked_at = np.r_[0:130, 200:300]
    for query in unit(5, seed=1):
        best = looked_at[np.argsort(-(rows[looked_at] @ query))[:7]]
        found = store.query(query, 7, recent=("b", 30.0))
        assert [(each.session, each.keyframe) for each in found] == [
            ("abc"[k // 100], k % 100) for k in best
        ]


def test_an_empty_store_is_no_error_and_makes_nothing(opened, unit):
    store = opened()
    store.tidy()
    store.add("a", [], [], unit(0))
    assert (len(store), store.query(unit(1)[0], 3)) == (0, ())


def test_what_others_write_is_seen_at_once(opened, unit):
    one, other = opened(), opened()
    other.add("a", [0], [0.0], unit(1))
    assert len(one) == 1
    one.add("b", [0], [0.0], unit(1))
    assert {each.session for each in other.query(unit(1)[0], 2)} == {"a", "b"}


def test_another_recognizer_or_size_is_refused(opened, unit):
    early, store = opened("version 2"), opened()
    store.add("a", [0], [0.0], unit(1))
    for act in (lambda: opened("version 2"), lambda: early.add("a", [0], [0.0], unit(1))):
        with pytest.raises(RecognizerError, match="of another recognizer, version 1"):
            act()
    for act in (
        lambda: store.query(unit(1, 9)[0], 1),
        lambda: store.add("a", [0], [0], unit(1, 9)),
    ):
        with pytest.raises(RecognizerError, match="has 9 values; those of the store have 16"):
            act()
    with pytest.raises(RecognizerError, match="not of unit length"):
        store.query(2 * unit(1)[0], 1)


def test_who_compares_by_itself_is_refused(tmp_path):
    with pytest.raises(RecognizerError, match="'SeqSlam' compares embeddings by itself"):
        PlaceStore(tmp_path, load("seqslam"))


def test_an_address_that_cannot_be_used_is_one_line(tmp_path, needs_lancedb):
    (tmp_path / "file").write_text("")
    known, line = load("gradients"), "cannot use the store: it is damaged, or its address"
    for address in (tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(LoopcloseError, match=f"{line}.*{address}$"):
            PlaceStore(address, known)
    with pytest.raises(LoopcloseError, match=r"in a folder or at s3://, gs://, az://, not at: db"):
        PlaceStore("db://cloud", known)


@pytest.mark.parametrize("content", [b"", b"nonsense" * 100])
def test_damage_is_one_line(opened, unit, tmp_path, content):
    store = opened()
    store.add("a", range(50), np.arange(50.0), unit(50))
    for file in (tmp_path / "store").rglob("*.lance"):
        if file.is_file():
            file.write_bytes(content)
    with pytest.raises(LoopcloseError, match="cannot use the store: it is damaged") as caught:
        opened().query(unit(1)[0], 3)
    assert ".rs:" not in str(caught.value)


def test_some_write_at_once_and_a_killed_one_leaves_whole_batches(opened, tmp_path):
    folder, store = tmp_path / "store", opened()
    doomed, *others = (writer(folder, *each) for each in (("doomed", 10**6), ("a", 5), ("b", 5)))
    told = [doomed.stdout.readline() for _ in range(3)]
    doomed.kill()
    told += doomed.communicate()[0].split()
    assert [each.wait() for each in others] == [0, 0]

    def seen(session):
        found = store.query(np.eye(16, dtype=np.float32)[0], 10**4, [session])
        return sorted(each.keyframe for each in found)

    left = seen("doomed")
    assert seen("a") == seen("b") == list(range(10))
    assert left == list(range(len(left)))
    assert len(left) % 2 == 0
    assert len(left) // 2 >= int(told[-1])
    store.tidy()
    assert len(store) == 20 + len(left)


def test_without_the_library_there_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "lancedb", None)
    with pytest.raises(LoopcloseError, match=r"not installed: pip install 'loopclose\[fleet\]'"):
        PlaceStore(tmp_path, load("gradients"))
