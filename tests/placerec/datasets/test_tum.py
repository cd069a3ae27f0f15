# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.datasets.tum import read_tum, read_tum_sessions
from placerec.errors import LoopcloseError


def test_desk_has_the_numbers_of_the_protocol(real_data):
    desk = read_tum(real_data("rgbd_dataset_freiburg1_desk"))
    revisits = desk.comparable & desk.same_place
    assert desk.name == "fr1_desk"
    assert len(desk) == 205
    assert revisits.any(axis=1).sum() == 128
    assert (desk.pairs & desk.same_place).sum() == 567
    assert desk.skipped == ()


def test_desk_in_the_room_of_the_other_recording(real_data):
    folders = [real_data(f"rgbd_dataset_freiburg1_{name}") for name in ("desk", "xyz")]
    both = read_tum_sessions(*folders)
    alone = read_tum(folders[0])
    assert both.name == "fr1_desk+fr1_xyz"
    assert both.paths[: len(alone)] == alone.paths
    assert (both.queries.size, both.references.size) == (205, 133)
    assert (both.same_place.any(axis=1)).sum() == 29
    i, j = np.argwhere(both.same_place)[0]
    metres = np.linalg.norm(both.positions_m[i] - both.positions_m[205 + j])
    assert metres < 0.6
    assert both.comparable.all()


@pytest.fixture
def recording(tmp_path, write_image):
    """Write a recording with a frame per second that goes out 1 m per frame and comes back."""

    def write(frames=9, truth_lag_s=0.0, images=None):
        names = [f"rgb/{i}.png" for i in range(frames)]
        for i, name in enumerate(names):
            write_image(tmp_path / name, seed=i)
        positions = [min(i, frames - 1 - i) for i in range(frames)]
        (tmp_path / "rgb.txt").write_text(
            "# timestamp filename\n" + "".join(f"{i}.0 {n}\n" for i, n in enumerate(names))
        )
        (tmp_path / "groundtruth.txt").write_text(
            "".join(f"{i + truth_lag_s} {x} 0 0 0 0 0 2\n" for i, x in enumerate(positions))
        )
        return tmp_path

    return write


def test_same_place_on_the_way_back(recording):
    dataset = read_tum(recording(), stride=1)
    revisits = np.argwhere(dataset.pairs & dataset.same_place).tolist()
    assert revisits == [[0, 8], [1, 7], [2, 6]]  # 3 and 5 are at one place, but only 2 s apart
    assert dataset.timestamps_s.tolist() == list(range(9))


def test_pairs_exactly_at_the_gap_do_not_count(recording):
    dataset = read_tum(recording(), stride=1)
    assert not dataset.comparable[0, 3]
    assert dataset.comparable[0, 4]


def test_frames_of_one_label_are_all_of_one_place(real_data):
    dataset = read_tum(real_data("rgbd_dataset_freiburg1_desk"))
    together = dataset.places[:, None] == dataset.places
    assert dataset.same_place[together].all()
    assert sorted(set(dataset.places)) == list(range(dataset.places.max() + 1))


def test_stride_counts_frames_with_truth(recording):
    dataset = read_tum(recording(frames=9), stride=4)
    assert [path.name for path in dataset.paths] == ["0.png", "4.png", "8.png"]


def test_lists_may_be_unsorted_and_name_a_stamp_twice(recording):
    folder = recording(frames=4)
    lines = (folder / "rgb.txt").read_text().splitlines()
    (folder / "rgb.txt").write_text("\n".join([*lines[:0:-1], "2.0 rgb/0.png"]))
    dataset = read_tum(folder, stride=1)
    assert [path.name for path in dataset.paths] == ["0.png", "1.png", "2.png", "3.png"]


def test_truth_within_20_ms_is_used_on_either_side(recording):
    for lag_s in (-0.019, 0.019):
        assert len(read_tum(recording(truth_lag_s=lag_s), stride=1)) == 9


def test_truth_of_another_time_is_refused(recording):
    with pytest.raises(LoopcloseError, match=r"^no image has a true pose within 0\.02 s.*0\.3 s"):
        read_tum(recording(truth_lag_s=0.3))


def test_missing_image_is_skipped_and_named(recording):
    folder = recording()
    (folder / "rgb/3.png").unlink()
    dataset = read_tum(folder, stride=1)
    assert len(dataset) == 8
    assert [broken.path.name for broken in dataset.skipped] == ["3.png"]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("rgb.txt", "# nothing\n", "the list names no image"),
        ("rgb.txt", "1.0\n", "line 1 is not"),
        ("rgb.txt", "soon rgb/0.png\n", "line 1 is not .*soon"),
        ("rgb.txt", None, r"cannot read rgb\.txt: No such file"),
        ("groundtruth.txt", "", "the list holds no true pose"),
        ("groundtruth.txt", "1 2 3\n", "line 1 is not .*1 2 3"),
        ("groundtruth.txt", "0 nan 0 0 0 0 0 1\n", "line 1 is not .* in finite numbers"),
        ("groundtruth.txt", "0 0 0 0 0 0 0 0\n", "line 1 has a quaternion of length zero"),
        ("places.txt", "0.0 kitchen\n", r'line 1 is not "timestamp place": .*kitchen'),
        ("places.txt", "0.0 1 2\n", "line 1 is not"),
        ("places.txt", ",\n", "line 1 is not"),
        ("places.txt", "0.0 1\n3.0 1\n", "names no place for 1 of 3 images, the first of 6"),
        ("groundtruth.txt", None, r"cannot read groundtruth\.txt: No such file"),
    ],
)
def test_unusable_list_is_refused_in_one_line(recording, name, content, message):
    folder = recording()
    if content is None:
        (folder / name).unlink()
    else:
        (folder / name).write_text(content)
    with pytest.raises(LoopcloseError, match=message) as caught:
        read_tum(folder)
    assert "\n" not in str(caught.value)


def test_list_that_is_no_text_is_refused(recording):
    folder = recording()
    (folder / "rgb.txt").write_bytes(b"\x80\xff\x00")
    with pytest.raises(LoopcloseError, match="not text in UTF-8"):
        read_tum(folder)


def test_places_that_come_with_a_recording_are_its_places(recording):
    folder = recording()
    assert read_tum(folder, stride=1).places.tolist() == [0, 1, 2, 3, 4, 3, 2, 1, 0]
    (folder / "places.txt").write_text("".join(f"{i}.0 {i // 3}\n" for i in range(9)))
    assert read_tum(folder, stride=1).places.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2]


def test_single_views_far_apart_in_time_are_all_used(tmp_path, write_image):
    for i in range(5):
        write_image(tmp_path / f"{i}.png", seed=i)
    (tmp_path / "rgb.txt").write_text("".join(f"{4 * i}.0 {i}.png\n" for i in range(5)))
    truth = "".join(f"{4 * i}.0 {i} 0 0 0 0 0 1\n" for i in range(5))
    (tmp_path / "groundtruth.txt").write_text(truth)
    assert len(read_tum(tmp_path)) == 5
