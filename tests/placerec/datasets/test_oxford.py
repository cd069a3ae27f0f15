# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import scipy.io

from placerec.datasets.oxford import read_oxford
from placerec.errors import RecognizerError

IMAGES = 16


@pytest.fixture
def college(tmp_path, write_image):
    """A folder as its authors publish it: image 14 shows the place of image 1, 13 that of 12."""
    for i in range(IMAGES):
        write_image(tmp_path / f"Images/{i + 1:04}.jpg", seed=i)
    truth = np.zeros((IMAGES, IMAGES), np.uint8)
    truth[14, 1] = truth[13, 12] = 1  # the lower triangle only
    scipy.io.savemat(tmp_path / "NewCollegeGroundTruth.mat", {"truth": truth})
    scipy.io.savemat(tmp_path / "ImageCollectionCoordinates.mat", {"GPS": np.zeros((IMAGES, 2))})
    return tmp_path


def test_either_triangle_of_the_matrix_counts(college):
    dataset = read_oxford(college)
    assert len(dataset) == IMAGES
    assert dataset.same_place[1, 14]
    assert dataset.same_place[14, 1]
    assert dataset.same_place.sum() == 4


def test_neighbours_in_order_are_not_compared(college):
    dataset = read_oxford(college)
    assert not dataset.comparable[2, 12]
    assert dataset.comparable[1, 12]
    assert np.argwhere(dataset.pairs & dataset.same_place).tolist() == [[1, 14]]


def test_matrix_may_be_logical_double_or_in_the_folder_masks(college):
    file = college / "NewCollegeGroundTruth.mat"
    expected = read_oxford(college).same_place
    truth = scipy.io.loadmat(file)["truth"]
    (college / "masks").mkdir()
    file.unlink()
    for kind in (bool, float):
        masks = college / "masks/CityCentreGroundTruth.mat"
        scipy.io.savemat(masks, {"truth": truth.astype(kind)}, do_compression=True)
        assert np.array_equal(read_oxford(college).same_place, expected)


def test_broken_image_is_skipped_and_named(college):
    (college / "Images/0001.jpg").write_bytes(b"")
    dataset = read_oxford(college)
    assert np.argwhere(dataset.pairs & dataset.same_place).tolist() == [[0, 13]]
    assert [broken.path.name for broken in dataset.skipped] == ["0001.jpg"]


def test_matrix_of_another_size_is_refused(college):
    (college / "Images/0001.jpg").unlink()
    with pytest.raises(RecognizerError, match="matrix of 16 x 16, but there are 15 images"):
        read_oxford(college)


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"gt": np.zeros((IMAGES, IMAGES))}, "has no matrix 'truth'"),
        ({"truth": "yes"}, "has no matrix 'truth'"),
    ],
)
def test_file_without_the_matrix_is_refused(college, variables, message):
    scipy.io.savemat(college / "NewCollegeGroundTruth.mat", variables)
    with pytest.raises(RecognizerError, match=message):
        read_oxford(college)


@pytest.mark.parametrize(
    "content", [b"", b"MATLAB 5.0 MAT-file", b"\x89HDF\r\n\x1a\n" + b"\0" * 99]
)
def test_broken_file_is_refused_in_one_line(college, content):
    (college / "NewCollegeGroundTruth.mat").write_bytes(content)
    with pytest.raises(RecognizerError, match="is no MATLAB file") as caught:
        read_oxford(college)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("missing", "message"),
    [("Images", "no folder Images"), ("NewCollegeGroundTruth.mat", r"no file \*GroundTruth\.mat")],
)
def test_missing_part_is_refused(college, missing, message):
    (college / missing).rename(college / "elsewhere")
    with pytest.raises(RecognizerError, match=message):
        read_oxford(college)
