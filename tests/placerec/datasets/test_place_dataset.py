# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from placerec.datasets.place_dataset import MOST_IMAGES, PlaceDataset, check_images, keep_readable
from placerec.errors import RecognizerError


@pytest.fixture
def dataset(tmp_path, write_image):
    """Four images, each compared with all others; image i is of place i // 2."""
    everyone = np.arange(4)
    places = everyone // 2
    return PlaceDataset(
        name="four",
        paths=tuple(write_image(tmp_path / f"{i}.png", seed=i) for i in range(4)),
        queries=everyone,
        references=everyone,
        same_place=places[:, None] == places,
        comparable=~np.eye(4, dtype=bool),
        places=places,
        timestamps_s=everyone * 0.5,
    )


def test_images_come_in_order(dataset):
    images = list(dataset)
    assert len(images) == len(dataset) == 4
    assert np.array_equal(images[2], dataset[2])
    assert not np.array_equal(images[2], images[3])


def test_each_pair_of_a_recording_counts_once(dataset):
    assert np.argwhere(dataset.pairs).tolist() == [[0, 1], [0, 2], [0, 3], [1, 2], [1, 3], [2, 3]]


def test_each_pair_of_two_drives_counts(dataset):
    two_drives = replace(
        dataset,
        queries=np.array([0, 1]),
        references=np.array([2, 3]),
        comparable=np.array([[True, True], [True, False]]),
    )
    assert np.argwhere(two_drives.pairs).tolist() == [[0, 0], [0, 1], [1, 0]]


def test_broken_images_are_named_and_left_out(dataset):
    dataset.paths[1].write_bytes(b"no image")
    kept = keep_readable(dataset)
    assert [path.name for path in kept.paths] == ["0.png", "2.png", "3.png"]
    assert [(broken.path, broken.why) for broken in kept.skipped] == [
        (dataset.paths[1], "not a readable image")
    ]
    assert kept.queries.tolist() == kept.references.tolist() == [0, 1, 2]
    assert np.argwhere(kept.same_place & kept.pairs).tolist() == [[1, 2]]
    assert kept.places.tolist() == [0, 1, 1]
    assert kept.timestamps_s.tolist() == [0.0, 1.0, 1.5]


def test_a_broken_query_takes_its_row_and_a_broken_reference_its_column(dataset):
    two_drives = replace(
        dataset,
        queries=np.array([0, 1]),
        references=np.array([2, 3]),
        same_place=np.array([[True, False], [False, True]]),
        comparable=np.ones((2, 2), bool),
    )
    kept = two_drives.subset(np.array([False, True, False, True]))
    assert kept.queries.tolist() == [0]
    assert kept.references.tolist() == [1]
    assert kept.same_place.tolist() == [[True]]


def test_sound_dataset_is_left_alone(dataset):
    assert keep_readable(dataset) is dataset


def test_mostly_broken_dataset_is_refused_in_one_line(dataset):
    for path in dataset.paths[:3]:
        path.unlink()
    with pytest.raises(RecognizerError, match=r"^3 of the 4 images of four are .*0\.png$"):
        keep_readable(dataset)


def test_dataset_without_images_is_refused(dataset):
    with pytest.raises(RecognizerError, match="four has no image"):
        keep_readable(dataset.subset(np.zeros(4, bool)))


def test_image_that_vanished_later_is_an_error(dataset):
    dataset.paths[2].unlink()
    with pytest.raises(RecognizerError, match="image 2 cannot be read: No such file"):
        list(dataset)


def test_files_are_looked_for_before_their_pairs_are_counted(tmp_path):
    paths = [tmp_path / f"{i}.png" for i in range(MOST_IMAGES + 1)]
    with pytest.raises(RecognizerError, match="walk has 20001 images, at most 20000"):
        check_images(paths, "walk")
    with pytest.raises(RecognizerError, match="19999 of the 19999 images of walk are missing"):
        check_images([*paths[:-3], tmp_path / ("x" * 300)], "walk")
    (tmp_path / "there").touch()
    check_images([tmp_path / "there", tmp_path / "gone"], "walk")
