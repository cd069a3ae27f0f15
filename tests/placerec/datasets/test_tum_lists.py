# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.datasets.tum_lists import as_numbers, nearest, read_images, read_lines, read_poses
from placerec.errors import LoopcloseError


def test_lines_are_those_that_hold_data(tmp_path):
    file = tmp_path / "list.txt"
    file.write_text("\ufeff# time name\n\n1.5  a.png\n  # more\n 2,b.png\n", encoding="utf-8")
    assert list(read_lines(file)) == [(3, "1.5  a.png"), (5, "2,b.png")]


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("1 2.5\t-3e1", [1.0, 2.5, -30.0]),
        ("1, 2,3,", [1.0, 2.0, 3.0]),
        ("1,5 2,25", [1.5, 2.25]),
        ("1,5;-2,25", [1.5, -2.25]),
        ("1;2 3", [1.0, 2.0, 3.0]),
        ("1 two", None),
        ("1 nan", None),
        ("1 inf", None),
        ("", None),
    ],
)
def test_numbers_are_finite_and_separated_by_blanks_or_commas(text, values):
    assert as_numbers(text) == values


def test_images_are_in_the_order_of_the_file_and_beside_it(tmp_path):
    file = tmp_path / "rgb.txt"
    file.write_text("2.0 rgb/two words.png\n1.0,\trgb/1.png\n")
    stamps_s, paths = read_images(file, [])
    assert stamps_s.tolist() == [2.0, 1.0]
    assert paths == [tmp_path / "rgb/two words.png", tmp_path / "rgb/1.png"]


def test_poses_are_eight_numbers_with_the_number_of_their_line(tmp_path):
    file = tmp_path / "groundtruth.txt"
    file.write_text("# made by hand\n1 2 3 4 0 0 0 2\n2,2,3,4,0,0,1,0\n")
    assert list(read_poses(file)) == [(2, [1, 2, 3, 4, 0, 0, 0, 2]), (3, [2, 2, 3, 4, 0, 0, 1, 0])]


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 0 0 0 0 0 1", "line 2 is not"),
        ("1 0 0 0 0 0 0 1 9", "line 2 is not"),
        ("1 0 0 x 0 0 0 1", "line 2 is not"),
        ("1 0 0 0 0 0 0 0", "line 2 has a quaternion of length zero"),
    ],
)
def test_a_line_that_is_no_pose_is_named(tmp_path, line, message):
    file = tmp_path / "groundtruth.txt"
    file.write_text(f"0 0 0 0 0 0 0 1\n{line}\n")
    with pytest.raises(LoopcloseError, match=message) as caught:
        list(read_poses(file))
    assert str(caught.value).endswith(f"{line!r}: {file}")


def test_nearest_prefers_the_earlier_of_two_equals():
    stamps_s = np.array([0.0, 1.0, 3.0])
    wanted_s = np.array([-5.0, 0.4, 0.5, 0.6, 2.5, 9.0])
    np.testing.assert_array_equal(nearest(stamps_s, wanted_s), [0, 0, 0, 1, 2, 2])
    np.testing.assert_array_equal(nearest(stamps_s[:1], wanted_s), np.zeros(6))


@pytest.mark.parametrize(
    "change",
    [
        lambda line: line + " 0.033 1",
        lambda line: line.replace(" ", ' "') + '"',
        lambda line: "'" + line.replace(" ", "','") + "'",
        lambda line: line.replace("/", "\\"),
        lambda line: line.replace(" ", " .\\").replace("/", "\\"),
        lambda line: line + "  # ok",
        lambda line: line.replace(".", ",", 1),
        lambda line: line.replace(".", ",", 1).replace(" ", ";"),
        lambda line: line.replace(" ", "\t"),
        lambda line: line + "\r",
        lambda line: "\ufeff" + line,
        lambda line: f"{line} {line.replace('rgb', 'depth')}",
    ],
)
@pytest.mark.parametrize("header", ["", "timestamp filename\n", "# time, name\n"])
def test_what_other_tools_write_is_read(tmp_path, change, header):
    (tmp_path / "rgb").mkdir()
    lines = [f"{1305031453 + i / 30:.6f} rgb/{i}.png" for i in range(5)]
    for i in range(5):
        (tmp_path / f"rgb/{i}.png").touch()
    file = tmp_path / "rgb.txt"
    file.write_text(header + "\n".join(map(change, lines)) + "\n")
    warnings = []
    stamps_s, paths = read_images(file, warnings)
    np.testing.assert_allclose(stamps_s, 1305031453 + np.arange(5) / 30.0, atol=1e-6)
    assert [path.resolve() for path in paths] == [tmp_path / f"rgb/{i}.png" for i in range(5)]
    assert warnings == []


@pytest.mark.parametrize("name", ["a # b.png", "a b.png", "a\\b.png", "5 a.png", "'a'.png"])
def test_a_name_that_is_there_is_taken_as_it_is(tmp_path, name):
    (tmp_path / name).touch()
    (tmp_path / "rgb.txt").write_text(f"1.5 {name}\n2.0,{name}\n")
    assert read_images(tmp_path / "rgb.txt", [])[1] == [tmp_path / name] * 2


def test_a_line_that_comes_twice_is_one(tmp_path):
    (tmp_path / "rgb.txt").write_text("1.0 a.png\n1.1 b.png\n1.0 a.png\n")
    warnings = []
    assert read_images(tmp_path / "rgb.txt", warnings)[0].tolist() == [1.0, 1.1]
    assert warnings == ["rgb.txt has 1 line(s) that came before; each was used once"]
