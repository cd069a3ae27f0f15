# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import scipy.io

from placerec.datasets import open_collection, open_dataset
from placerec.errors import RecognizerError


def test_each_format_is_told_by_its_files(tmp_path, write_image):
    write_image(tmp_path / "tum/rgb/0.png")
    (tmp_path / "tum/rgb.txt").write_text("0 rgb/0.png")
    (tmp_path / "tum/groundtruth.txt").write_text("0 0 0 0 0 0 0 1")
    for drive in ("query", "ref"):
        write_image(tmp_path / f"drives/{drive}/0.png")
    write_image(tmp_path / "college/Images/0001.jpg")
    scipy.io.savemat(tmp_path / "college/NewCollegeGroundTruth.mat", {"truth": np.zeros((1, 1))})
    sizes = {n: len(open_dataset(str(tmp_path / n))) for n in ("tum", "drives", "college")}
    assert sizes == {"tum": 1, "drives": 2, "college": 1}
    with pytest.raises(RecognizerError, match="only a folder of clips has parts, no 'test' here"):
        open_dataset(f"{tmp_path / 'tum'}:test")


def test_a_folder_of_datasets_is_opened_whole_and_a_dataset_alone(tmp_path, write_image):
    for name in ("b", "a"):
        for drive in ("query", "ref"):
            write_image(tmp_path / f"drives/{name}/{drive}/0.png")
    both = open_collection(str(tmp_path / "drives"))
    assert [dataset.name for dataset in both] == ["a", "b"]
    (alone,) = open_collection(str(tmp_path / "drives/a"))
    assert alone.paths == both[0].paths


def test_every_folder_among_datasets_has_to_be_one(tmp_path, write_image):
    for drive in ("query", "ref"):
        write_image(tmp_path / f"drives/a/{drive}/0.png")
    (tmp_path / "drives/notes").mkdir()
    with pytest.raises(RecognizerError, match=r"no known format.*/drives/notes$"):
        open_collection(str(tmp_path / "drives"))
    with pytest.raises(RecognizerError, match=r"no known format.*/notes$"):
        open_collection(str(tmp_path / "drives/notes"))
    with pytest.raises(RecognizerError, match=r"no such folder.*/nowhere$"):
        open_collection(str(tmp_path / "nowhere"))


def test_part_of_clips_is_named_behind_a_colon(tmp_path, write_image):
    rows = ["image_path,floor"]
    for floor in ("floor6", "floor9"):
        path = write_image(tmp_path / f"tower/{floor}/hall_frame_01.jpg")
        rows.append(f"{path.relative_to(tmp_path / 'tower')},{floor}")
    (tmp_path / "tower/dataset.csv").write_text("\n".join(rows))
    assert open_dataset(f"{tmp_path}/tower").name == "tower:test"
    validation = open_dataset(f"{tmp_path}/tower:validation")
    assert validation.paths[0].parent.name == "floor9"


@pytest.fixture
def sessions(tmp_path, write_image):
    """Write two recordings that go the same three metres, in a folder whose name has a plus."""
    for name in ("a+", "b"):
        for i in range(3):
            write_image(tmp_path / f"{name}/{i}.png", seed=i)
    return tmp_path


def record(folder):
    (folder / "rgb.txt").write_text("".join(f"{i}.0 {i}.png\n" for i in range(3)))
    (folder / "groundtruth.txt").write_text("".join(f"{i}.0 {i} 0 0 0 0 0 1\n" for i in range(3)))


def test_one_recording_is_looked_for_in_another(sessions):
    record(sessions / "a+")
    record(sessions / "b")
    dataset = open_dataset(f"{sessions}/a++{sessions}/b")
    assert (dataset.name, len(dataset)) == ("a++b", 2)  # of each, every third frame
    assert dataset.queries.tolist() == [0]
    assert dataset.references.tolist() == [1]
    assert open_dataset(f"{sessions}/a+").name == "a+"


def test_two_folders_of_images_match_within_a_tolerance(sessions):
    matches = [[1, 1, 0], [1, 1, 1], [0, 1, 1]]
    dataset = open_dataset(f"{sessions}/a++{sessions}/b:1")
    assert dataset.same_place.astype(int).tolist() == matches
    assert dataset.comparable.all()
    assert open_dataset(f"{sessions}/a++{sessions}/b").same_place.all()  # two frames, untold


@pytest.mark.parametrize(
    ("second", "message"),
    [
        ("b", r"two TUM RGB-D recordings, or two folders of images"),
        ("b:2", r"two TUM RGB-D recordings, or two folders of images"),
        ("missing", "no such folder"),
        ("missing:2", "no such folder"),
        ("a+", "both sides of .+ are one folder"),
    ],
)
def test_sessions_that_do_not_go_together(sessions, second, message):
    record(sessions / "a+")
    with pytest.raises(RecognizerError, match=message):
        open_dataset(f"{sessions}/a++{sessions}/{second}")


def test_a_tolerance_is_a_number_and_there_must_be_images(sessions):
    with pytest.raises(RecognizerError, match="number of frames from 0, not '-1'"):
        open_dataset(f"{sessions}/a++{sessions}/b:-1")
    (sessions / "empty").mkdir()
    with pytest.raises(RecognizerError, match="no image in the folder: "):
        open_dataset(f"{sessions}/b+{sessions}/empty")


@pytest.mark.parametrize("source", ["missing", "missing:test", ""])
def test_missing_folder_is_refused_in_one_line(tmp_path, source):
    with pytest.raises(RecognizerError, match=r"(no such folder|no known format).*: "):
        open_dataset(str(tmp_path / source))


def test_unknown_format_lists_the_known_ones(tmp_path):
    with pytest.raises(RecognizerError, match=r"TUM RGB-D.*New College.*clips") as caught:
        open_dataset(str(tmp_path))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", [5000 * "x", "{0}:part", "{0}+{0}", "a\0b", "a\0b:part"])
def test_a_name_that_no_folder_can_have_is_that_of_none(name):
    with pytest.raises(RecognizerError, match="there is no such folder"):
        open_dataset(name.format(5000 * "x"))
