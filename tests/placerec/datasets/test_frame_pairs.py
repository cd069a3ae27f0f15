# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.datasets.frame_pairs import read_drives, read_frame_pairs
from placerec.errors import LoopcloseError


def test_corridor_has_a_tolerance_of_two_frames(real_data):
    corridor = read_frame_pairs(real_data("corridor"))
    steps = np.abs(np.arange(111)[:, None] - np.arange(111))
    assert len(corridor) == 222
    assert np.array_equal(corridor.same_place, steps <= 2)
    assert corridor.pairs.all()
    assert corridor.paths[corridor.queries[5]].parts[-2:] == ("query", "0000005.jpg")
    assert corridor.paths[corridor.references[5]].parts[-2:] == ("ref", "0000005.jpg")


@pytest.fixture
def drives(tmp_path, write_image):
    for i in range(4):
        write_image(tmp_path / f"query/{i}.png", seed=i)
        write_image(tmp_path / f"ref/{i}.png", seed=i)
    return tmp_path


def test_without_a_table_the_tolerance_decides(drives):
    dataset = read_frame_pairs(drives, tolerance_frames=1)
    assert dataset.same_place.astype(int).tolist() == [
        [1, 1, 0, 0],
        [1, 1, 1, 0],
        [0, 1, 1, 1],
        [0, 0, 1, 1],
    ]


def test_frames_are_counted_without_what_is_no_frame_of_the_drive(tmp_path, write_image):
    for drive in ("query", "ref"):
        for i in range(12):
            write_image(tmp_path / drive / f"{i}.png", seed=i)
        (tmp_path / drive / "Thumbs.db").write_bytes(b"no image")
    for i in range(12):  # on one side only: all numbers behind would be off
        (tmp_path / "query" / f"._{i}.png").write_bytes(b"of a Mac")
    for dataset in (
        read_frame_pairs(tmp_path),
        read_drives(tmp_path / "query", tmp_path / "ref"),
    ):
        for i, k in np.argwhere(dataset.same_place):
            query, reference = dataset.paths[i], dataset.paths[dataset.references[k]]
            assert abs(int(query.stem) - int(reference.stem)) <= 2
        assert dataset.skipped == () and len(dataset) == 24


def test_table_decides_where_there_is_one(drives):
    (drives / "ground_truth.csv").write_text("query,refs\n0,3\n2,0;1\n3,\n")
    dataset = read_frame_pairs(drives)
    assert np.argwhere(dataset.same_place).tolist() == [[0, 3], [2, 0], [2, 1]]


def test_broken_reference_is_skipped_and_named(drives):
    (drives / "ref/1.png").write_bytes(b"")
    dataset = read_frame_pairs(drives)
    assert dataset.same_place.shape == (4, 3)
    assert [broken.path.name for broken in dataset.skipped] == ["1.png"]


@pytest.mark.parametrize(
    ("table", "message"),
    [
        ("query,refs\n0,4\n", "line 2 names an image that is not there: .* ref/ 4"),
        ("query,refs\n4,0\n", "line 2 names an image that is not there: query/ has 4"),
        ("query,refs\n0,one\n", "line 2 is not"),
        ("query,refs\n0,-1\n", "line 2 is not"),
        ("query,refs\n0\n", "line 2 of the table is too short"),
        ("a,b\n0,1\n", "the table has no column query or refs"),
    ],
)
def test_unusable_table_is_refused_in_one_line(drives, table, message):
    (drives / "ground_truth.csv").write_text(table)
    with pytest.raises(LoopcloseError, match=message):
        read_frame_pairs(drives)


def test_missing_drive_is_refused(tmp_path, write_image):
    write_image(tmp_path / "query/0.png")
    with pytest.raises(LoopcloseError, match="there is no folder ref"):
        read_frame_pairs(tmp_path)
