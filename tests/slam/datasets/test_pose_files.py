# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from placerec.errors import LoopcloseError
from slam.datasets.pose_files import read_pose_file, read_trajectory, write_pose_file
from slam.datasets.pose_formats import FORMATS
from slam.geometry import se3
from slam.types import Trajectory

COUNT = 8
STAMPS = tuple(f"{100 + i / 10:.4f}" for i in range(COUNT))
STAMPS_NS = tuple(f"{1403636579763555584 + 50_000_000 * i}" for i in range(COUNT))
STAMPS_S = np.array(STAMPS, dtype=np.float64)
STAMPS_NS_S = np.array(STAMPS_NS, dtype=np.float64) / 1e9
T = se3.exp(np.linspace(0.0, 1.0, COUNT)[:, None] * np.array([0.3, -0.9, 0.5, 1.0, 2.0, -0.7]))
FLAT = se3.exp(np.linspace(0.0, 1.0, COUNT)[:, None] * np.array([0.0, 0.0, 2.5, 1.0, 2.0, 0.0]))
EUROC_HEADER = "#timestamp,p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],..."


def words(*values):
    return [f"{value:.12f}" for value in values]


def quaternion(pose, w_first=False):
    values = se3.to_quaternion(pose[:3, :3])
    return words(*pose[:3, 3], *(np.roll(values, 1) if w_first else values))


def yaw(pose):
    return words(pose[0, 3], pose[1, 3], np.arctan2(pose[1, 0], pose[0, 0]))


def tum(poses=T, stamps=STAMPS):
    return [" ".join([s, *quaternion(p)]) for s, p in zip(stamps, poses, strict=True)]


def euroc(more=()):
    stamped = zip(STAMPS_NS, T, strict=True)
    return [",".join([s, *quaternion(p, w_first=True), *more]) for s, p in stamped]


def rows(count, stamps=None):
    lines = [" ".join(words(*p[:count].ravel())) for p in T]
    return [f"{s} {line}" for s, line in zip(stamps, lines, strict=True)] if stamps else lines


WRITTEN = {
    "TUM": tum(),
    "TUM, with commas": [line.replace(" ", ",") for line in tum()],
    "TUM, with a header": ["# made by hand", "", "timestamp tx ty tz qx qy qz qw", *tum()],
    "KITTI": rows(3),
    "KITTI with times": rows(3, STAMPS),
    "matrices": rows(4),
    "matrices with times": rows(4, STAMPS),
    "planar": [" ".join([s, *yaw(p)]) for s, p in zip(STAMPS, FLAT, strict=True)],
    "EuRoC, 8 columns": [EUROC_HEADER, *euroc()],
    "EuRoC, 17 columns": [EUROC_HEADER, *euroc(["0.1"] * 9)],
    "EuRoC, without a mark": ["timestamp, x, y, z, qw, qx, qy, qz", *euroc()],
}


def write(folder: Path, lines: list[str], name: str = "poses.txt") -> Path:
    file = folder / name
    file.write_text("\n".join(lines) + "\n")
    return file


def numbers(file: Path) -> np.ndarray:
    lines = [line for line in file.read_text().splitlines() if not line.startswith("#")]
    return np.array([[float(word) for word in line.replace(",", " ").split()] for line in lines])


def times_of(name):
    return STAMPS_NS_S if name.startswith("EuRoC") else STAMPS_S


@pytest.mark.parametrize("name", WRITTEN)
def test_poses_are_read_however_they_are_written(tmp_path, name):
    found = read_pose_file(write(tmp_path, WRITTEN[name]), times_of(name))
    assert found.format.name == name.split(",")[0]
    expected = FLAT if name == "planar" else T
    np.testing.assert_allclose(found.trajectory.T_world_cam, expected, atol=1e-9)
    np.testing.assert_array_equal(found.trajectory.timestamps_s, times_of(name))
    assert found.warnings == ()


@pytest.mark.parametrize("name", WRITTEN)
def test_poses_are_written_as_they_came(tmp_path, name):
    file = write(tmp_path, WRITTEN[name])
    source = read_pose_file(file, times_of(name))
    again = tmp_path / f"again{source.format.ending}"
    write_pose_file(again, source, source.trajectory)
    read = read_pose_file(again, times_of(name))
    assert (read.format, read.stamps) == (source.format, source.stamps)
    np.testing.assert_array_equal(read.trajectory.timestamps_s, source.trajectory.timestamps_s)
    np.testing.assert_allclose(
        read.trajectory.T_world_cam, source.trajectory.T_world_cam, atol=1e-8
    )
    plain = [line for line in WRITTEN[name] if line and not (line[0].isalpha() or line[0] == "#")]
    before = numbers(write(tmp_path, plain, "plain.txt"))[:, : source.format.count]
    np.testing.assert_allclose(numbers(again), before, atol=1e-8)
    assert source.format.separator in again.read_text().splitlines()[-1]
    assert again.read_text().startswith("#") is name.startswith("EuRoC")


def test_times_are_written_to_the_letter(tmp_path):
    stamps = ("1e2", "0100.10", "100.2000000000000001", "+100.3")
    source = read_pose_file(write(tmp_path, tum(T[:4], stamps)), STAMPS_S)
    assert source.stamps == stamps
    write_pose_file(tmp_path / "again.txt", source, source.trajectory)
    lines = (tmp_path / "again.txt").read_text().splitlines()
    assert tuple(line.split()[0] for line in lines) == stamps


def test_only_those_that_are_known_are_written_each_at_its_time(tmp_path):
    source = read_pose_file(write(tmp_path, WRITTEN["EuRoC, 8 columns"]), STAMPS_NS_S)
    known = [2, 3, 6]
    hardly = se3.exp(np.full((3, 6), -1e-12))
    corrected = Trajectory(source.trajectory.timestamps_s[known], hardly)
    write_pose_file(tmp_path / "again.csv", source, corrected)
    header, *lines = (tmp_path / "again.csv").read_text().splitlines()
    assert header.startswith("#")
    nothing = ",0.000000000,0.000000000,0.000000000,1.000000000,0.000000000,0.000000000,0.000000000"
    assert lines == [STAMPS_NS[k] + nothing for k in known]


def test_each_format_has_a_number_of_columns_of_its_own():
    assert len({form.count for form in FORMATS}) == len(FORMATS)


def test_a_quaternion_may_have_any_length_and_a_matrix_few_digits(tmp_path):
    long = [" ".join([s, "1", "2", "3", "0", "0", "3", "3"]) for s in STAMPS]
    found = read_pose_file(write(tmp_path, long), STAMPS_S).trajectory.T_world_cam[0]
    np.testing.assert_allclose(found[:3, :3] @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], atol=1e-12)
    few = [" ".join(f"{value:.3f}" for value in p[:3].ravel()) for p in T]
    R = read_pose_file(write(tmp_path, few), STAMPS_S).trajectory.T_world_cam[:, :3, :3]
    np.testing.assert_allclose(R @ R.swapaxes(1, 2), np.tile(np.eye(3), (COUNT, 1, 1)), atol=1e-12)


def test_lines_without_times_belong_to_the_images_one_to_one(tmp_path):
    images_s = np.array([5.0, 5.1, 5.3, 5.4, 5.5, 5.6, 5.7, 6.0])
    found = read_pose_file(write(tmp_path, rows(3)), images_s)
    np.testing.assert_array_equal(found.trajectory.timestamps_s, images_s)
    assert found.stamps == ()


def test_poses_out_of_order_are_sorted_and_of_equal_times_the_first_is_taken(tmp_path):
    lines = tum()
    later = tum(T[5:6], STAMPS[2:3])
    shuffled = [*lines[4:], *lines[:3], *later, lines[3]]
    found = read_pose_file(write(tmp_path, shuffled), STAMPS_S)
    np.testing.assert_array_equal(found.trajectory.timestamps_s, STAMPS_S)
    np.testing.assert_allclose(found.trajectory.T_world_cam, T, atol=1e-9)
    assert found.stamps == STAMPS
    unsorted, twice = found.warnings
    assert "poses.txt is not in the order of time" in unsorted
    assert "1 line(s) whose timestamp came before" in twice


def broken(line, **changes):
    """Return a file whose one line, numbered from 1, is changed: words by column, from 0."""
    lines = tum()
    values = lines[line - 1].split()
    for column, word in changes.items():
        values[int(column[1:])] = word
    lines[line - 1] = " ".join(values)
    return lines


ZERO = {f"c{column}": "0" for column in (4, 5, 6, 7)}
SHEARED = " ".join(["1 0.5 0 0", "0 1 0 0", "0 0 1 0"])
MIRRORED = " ".join(["1 0 0 0", "0 1 0 0", "0 0 -1 0"])


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        ([], "the file holds no pose (TUM: time tx ty tz qx qy qz qw;"),
        (["# nothing", "", "timestamp tx ty tz"], "the file holds no pose"),
        (broken(3, c2="nan"), "line 3 holds something else than finite numbers"),
        (broken(3, c0="nan"), "line 3 holds something else than finite numbers"),
        (broken(8, c7="-inf"), "line 8 holds something else than finite numbers"),
        (broken(5, c1="1.0.0"), "line 5 holds something else than finite numbers"),
        (["1 2 3"] * 9, "line 1 has 3 numbers, which is no known way to write a pose"),
        ([*tum(), "100.9 1 2 3"], "line 9 has 4 numbers, the first one 8"),
        ([*tum()[:4], rows(3)[0]], "line 5 has 12 numbers, the first one 8"),
        (broken(6, **ZERO), "line 6 has a quaternion of length zero"),
        ([*rows(3)[:7], SHEARED], "line 8 is no rotation and translation"),
        ([*rows(3)[:7], MIRRORED], "line 8 is no rotation and translation"),
        ([*rows(4)[:7], f"{SHEARED} 0 0 0 1"], "line 8 is no rotation and translation"),
        (rows(3)[:6], "there has to be one per image, but there are 6 for 8 images"),
        ([*rows(4), rows(4)[0]], "there has to be one per image, but there are 9 for 8 images"),
    ],
    ids=[
        "empty",
        "a header alone",
        "nan",
        "nan for a time",
        "infinite",
        "no number",
        "3 columns",
        "fewer columns later",
        "more columns later",
        "quaternion of length zero",
        "sheared",
        "mirrored",
        "sheared (4, 4)",
        "too few without times",
        "too many without times",
    ],
)
def test_what_is_no_file_of_poses_is_refused(tmp_path, lines, said):
    refused(write(tmp_path, lines), said)


def refused(file, said, images_s=STAMPS_S):
    with pytest.raises(LoopcloseError) as error:
        read_pose_file(file, images_s)
    message = str(error.value)
    assert said in message
    assert "\n" not in message
    assert message.endswith(str(file))


def test_a_line_is_shown_and_counted_as_the_editor_does(tmp_path):
    lines = ["# a comment", "", *broken(2, c3="oops")]
    refused(write(tmp_path, lines), "line 4 holds something else than finite numbers: '100.1000 ")


def test_a_file_that_is_not_there_or_is_not_text_is_refused(tmp_path):
    refused(tmp_path / "none.txt", "cannot read none.txt: No such file")
    (tmp_path / "image.txt").write_bytes(b"\x89PNG\xff\xfe\x00")
    refused(tmp_path / "image.txt", "image.txt is not text")


@pytest.mark.parametrize("later_s", [-0.75, 0.75, 1e9])
def test_poses_of_another_time_than_the_images_are_refused(tmp_path, later_s):
    file = write(tmp_path, tum())
    refused(file, "the poses are of 100.000 to 100.700 s", STAMPS_S + later_s)
    read_pose_file(file, STAMPS_S + np.clip(later_s, -0.65, 0.65))


@pytest.mark.parametrize("metres", [0.3, 5.0])
def test_poses_of_two_frames_that_are_mixed_are_refused(tmp_path, metres):
    poses = se3.exp(np.multiply.outer(np.arange(COUNT) / 100, [0.0, 0.0, 0.1, 1.0, 0.0, 0.0]))
    poses[1::2, 1, 3] += metres
    refused(write(tmp_path, tum(poses)), f"leap to and fro, by {metres:.2f} m")


def test_a_camera_that_trembles_or_turns_back_once_is_no_mixture(tmp_path):
    trembling = np.tile(np.eye(4), (COUNT, 1, 1))
    trembling[1::2, 1, 3] = 0.02
    back = np.tile(np.eye(4), (COUNT, 1, 1))
    back[:, 0, 3] = [0.0, 1.0, 2.0, 3.0, 3.0, 2.0, 1.0, 0.0]
    for poses in (trembling, back):
        found = read_pose_file(write(tmp_path, tum(poses)), STAMPS_S)
        np.testing.assert_allclose(found.trajectory.T_world_cam, poses, atol=1e-9)


def test_a_folder_that_is_not_there_cannot_be_written_to(tmp_path):
    source = read_pose_file(write(tmp_path, tum()), STAMPS_S)
    with pytest.raises(LoopcloseError):
        write_pose_file(tmp_path / "poses.txt" / "again.txt", source, source.trajectory)


@pytest.mark.parametrize("line", ["lost track here", "inf 0 0 0 0 0 0 1"])
def test_only_the_first_line_may_name_the_columns(tmp_path, line):
    file = tmp_path / "poses.txt"
    lines = tum()
    file.write_text("\n".join(["time x y z qx qy qz qw", *lines]) + "\n")
    assert len(read_pose_file(file, STAMPS_S).trajectory) == COUNT
    file.write_text("\n".join([*lines[:4], line, *lines[4:]]) + "\n")
    with pytest.raises(LoopcloseError, match="line 5"):
        read_pose_file(file, STAMPS_S)


def test_poses_of_two_frames_are_refused_without_times_too(tmp_path):
    mixed = T.copy()
    mixed[::2, 0, 3] += 5.0
    rows = [" ".join(words(*pose[:3].ravel())) for pose in mixed]
    (tmp_path / "kitti.txt").write_text("\n".join(rows) + "\n")
    with pytest.raises(LoopcloseError, match="two frames or two bodies are mixed"):
        read_pose_file(tmp_path / "kitti.txt", STAMPS_S)


@pytest.mark.parametrize("per_s", [1e3, 1e6, 1e9])
@pytest.mark.parametrize("start_s", [100.0, 1.3e9])
def test_times_in_another_unit_are_seconds_and_said(tmp_path, per_s, start_s):
    images_s = start_s + np.arange(COUNT) / 10
    stamps = [f"{time_s * per_s:.0f}" for time_s in images_s]
    found = read_pose_file(write(tmp_path, tum(T, stamps)), images_s)
    assert (found.format.name, found.stamps) == ("TUM", tuple(stamps))
    np.testing.assert_allclose(found.trajectory.timestamps_s, images_s)
    np.testing.assert_allclose(found.trajectory.T_world_cam, T, atol=1e-9)
    assert "which lays them on the images'" in found.warnings[0]


@pytest.mark.parametrize("first", [0, 1])
def test_times_may_be_the_numbers_of_the_images(tmp_path, first):
    stamps = [str(first + i) for i in range(COUNT)]
    found = read_pose_file(write(tmp_path, tum(T, stamps)), STAMPS_S)
    np.testing.assert_array_equal(found.trajectory.timestamps_s, STAMPS_S)
    assert found.stamps == tuple(stamps)
    assert "numbers of the images" in found.warnings[0]


def test_a_clock_that_starts_again_is_refused(tmp_path):
    stamps = [f"{100 + i % 8 / 10:.4f}" for i in range(16)]
    poses = tum(np.concatenate([T, T]), stamps)
    refused(write(tmp_path, poses), "the clock of the poses starts again 1 time(s)")


def test_poses_with_decimal_commas_are_read(tmp_path):
    lines = [line.replace(".", ",") for line in tum()]
    found = read_pose_file(write(tmp_path, lines), STAMPS_S)
    np.testing.assert_allclose(found.trajectory.T_world_cam, T, atol=1e-9)
    assert found.stamps == STAMPS


@pytest.mark.parametrize("kind", [kind for kind in WRITTEN if kind != "planar"])
def test_poses_are_compared_as_they_stand(tmp_path, kind):
    path = tmp_path / "poses"
    path.write_text("\n".join(WRITTEN[kind]) + "\n")
    found = read_trajectory(path)
    np.testing.assert_allclose(found.trajectory.T_world_cam, T, atol=1e-8)
    expected_s = STAMPS_NS_S if "EuRoC" in kind else STAMPS_S
    expected_s = expected_s if found.format.has_time else np.arange(COUNT)
    np.testing.assert_array_equal(found.trajectory.timestamps_s, expected_s)


@pytest.mark.parametrize(
    ("lines", "complaint"),
    [
        ([*tum(), tum()[-1]], "line 9 has the time of line 8"),
        (tum()[::-1], "line 2 has a time before that of line 1"),
        (["1 1e13 0 0 0 0 0 1"], "line 1 holds no numbers that a place can have"),
        (["1 nan 0 0 0 0 0 1"], "line 1 holds something else than finite numbers"),
    ],
)
def test_nothing_is_sorted_or_left_out_where_poses_are_compared(tmp_path, lines, complaint):
    path = tmp_path / "poses"
    path.write_text("\n".join(lines) + "\n")
    with pytest.raises(LoopcloseError, match=complaint):
        read_trajectory(path)
