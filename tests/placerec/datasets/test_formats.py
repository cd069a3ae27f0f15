# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
import scipy.io

from placerec.datasets import open_dataset
from placerec.recognizer import RecognizerError


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


def test_part_of_clips_is_named_behind_a_colon(tmp_path, write_image):
    rows = ["image_path,floor"]
    for floor in ("floor6", "floor9"):
        path = write_image(tmp_path / f"tower/{floor}/hall_frame_01.jpg")
        rows.append(f"{path.relative_to(tmp_path / 'tower')},{floor}")
    (tmp_path / "tower/dataset.csv").write_text("\n".join(rows))
    assert open_dataset(f"{tmp_path}/tower").name == "tower:test"
    validation = open_dataset(f"{tmp_path}/tower:validation")
    assert validation.paths[0].parent.name == "floor9"


@pytest.mark.parametrize("source", ["missing", "missing:test", ""])
def test_missing_folder_is_refused_in_one_line(tmp_path, source):
    with pytest.raises(RecognizerError, match=r"(no such folder|no known format).*: "):
        open_dataset(str(tmp_path / source))


def test_unknown_format_lists_the_known_ones(tmp_path):
    with pytest.raises(RecognizerError, match=r"TUM RGB-D.*New College.*clips") as caught:
        open_dataset(str(tmp_path))
    assert "\n" not in str(caught.value)
