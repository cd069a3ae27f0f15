# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.datasets.clips import PARTS, TEST_FLOORS, VALIDATION_FLOORS, read_clips
from placerec.errors import LoopcloseError


def test_parts_of_the_tower_share_no_floor_and_lose_no_image(real_data):
    parts = {part: read_clips(real_data("ie_tower"), part) for part in PARTS}
    floors = {part: {path.parent.name for path in data.paths} for part, data in parts.items()}
    assert floors["test"] == TEST_FLOORS
    assert floors["validation"] == VALIDATION_FLOORS
    assert not floors["train"] & (TEST_FLOORS | VALIDATION_FLOORS)
    assert sum(map(len, floors.values())) == 25
    assert sum(map(len, parts.values())) == 2877


@pytest.fixture
def tower(tmp_path, write_image):
    """Write a building: {floor: {clip: number of frames}}."""

    def write(floors):
        rows = ["image_path,floor,area,section,split"]
        for floor, clips in floors.items():
            for clip, frames in clips.items():
                for number in range(1, frames + 1):
                    name = f"images/{floor}/{clip}_frame_{number:06}.jpg"
                    write_image(tmp_path / name, seed=number)
                    rows.append(f"{name},{floor},{clip},above-ground,gallery")
        (tmp_path / "dataset.csv").write_text("\n".join(rows))
        return tmp_path

    return write


def test_neighbours_in_a_clip_are_of_one_place(tower):
    dataset = read_clips(tower({"floor6": {"hall": 4}, "floor11": {"hall": 1}}))
    assert [path.parent.name for path in dataset.paths] == ["floor11", *4 * ["floor6"]]
    neighbours = [[1, 2], [1, 3], [2, 3], [2, 4], [3, 4]]
    assert np.argwhere(dataset.pairs & dataset.same_place).tolist() == neighbours


def test_only_other_floors_are_surely_other_places(tower):
    dataset = read_clips(tower({"floor6": {"hall": 4, "stairs": 2}, "floor11": {"hall": 1}}))
    different = np.argwhere(dataset.pairs & ~dataset.same_place).tolist()
    assert different == [[0, i] for i in range(1, 7)]  # not 1 and 4: ends of the clip may meet
    assert not dataset.comparable.diagonal().any()


def test_labels_are_runs_of_a_clip(tower):
    dataset = read_clips(tower({"floor6": {"a": 3, "b": 8, "c": 1, "d": 2}}))
    assert dataset.places.tolist() == [0, 0, 0, 1, 1, 1, 2, 2, 2, 2, 2, 3, 4, 4]


def test_clips_of_one_name_on_two_floors_are_two(tower):
    dataset = read_clips(tower({"floor6": {"hall": 3}, "floor11": {"hall": 3}}))
    assert dataset.places.tolist() == [0, 0, 0, 1, 1, 1]
    assert not dataset.same_place[0, 3:].any()


def test_floors_that_are_not_kept_apart_are_for_training(tower):
    folder = tower({"floor6": {"a": 1}, "floor9": {"a": 2}, "floor10": {"a": 3}, "attic": {"a": 4}})
    assert [len(read_clips(folder, part)) for part in PARTS] == [7, 2, 1]


def test_broken_image_is_skipped_and_named(tower):
    folder = tower({"floor6": {"hall": 4}})
    (folder / "images/floor6/hall_frame_000002.jpg").unlink()
    dataset = read_clips(folder)
    assert np.argwhere(dataset.pairs & dataset.same_place).tolist() == [[0, 1], [1, 2]]
    assert [broken.path.name for broken in dataset.skipped] == ["hall_frame_000002.jpg"]


def test_unknown_part_is_refused(tower):
    with pytest.raises(LoopcloseError, match=r"no part 'val'; there are: train, validation, test"):
        read_clips(tower({"floor6": {"hall": 1}}), "val")


def test_part_without_images_is_refused(tower):
    with pytest.raises(LoopcloseError, match="no image is of a floor for validation"):
        read_clips(tower({"floor6": {"hall": 1}}), "validation")


def test_file_name_of_another_kind_is_refused(tower):
    folder = tower({"floor6": {"hall": 1}})
    (folder / "dataset.csv").write_text("image_path,floor\nimages/IMG_1234.jpg,floor6\n")
    with pytest.raises(LoopcloseError, match=r"line 2 names 'IMG_1234\.jpg', not like"):
        read_clips(folder)


def test_paths_of_windows_are_read(tower):
    folder = tower({"floor6": {"a": 4}})
    table = folder / "dataset.csv"
    before = read_clips(folder).paths
    table.write_text(table.read_text().replace("images/", "images\\"))
    assert read_clips(folder).paths == before


@pytest.mark.parametrize("digits", [300, 5000])
def test_a_name_too_long_for_a_file_is_refused(tower, digits):
    folder = tower({"floor6": {"hall": 1}})
    name = f"images/floor6/hall_frame_{digits * '9'}.jpg"
    (folder / "dataset.csv").write_text(f"image_path,floor\n{name},floor6\n")
    with pytest.raises(LoopcloseError, match=r"line 2 names 'hall_frame_999"):
        read_clips(folder)
