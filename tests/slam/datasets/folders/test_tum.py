# SPDX-License-Identifier: Apache-2.0
import os
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placerec.datasets.tum_lists import read_lines
from slam.config import InputConfig
from slam.datasets import Sequence, open_sequence
from slam.datasets.folders.tum import associate

MakeFolder = Callable[..., Path]
Export = Callable[[str, Any], Path]
Fails = Callable[..., str]
Opened = Callable[[Path], Sequence]
CONFIG = InputConfig()
DATA = Path(os.environ.get("LOOPCLOSE_DATA", Path(__file__).parents[5] / "shared/data"))
DESK = DATA / "rgbd_dataset_freiburg1_desk"


def edit(file: Path, change: Callable[[list[str]], list[str]]) -> None:
    file.write_text("\n".join(change(file.read_text().splitlines())) + "\n")


def truth_lines(count: int = 6) -> list[str]:
    return [f"{100 + i / 10} {i} 0 0 0 0 0 1" for i in range(count)]


@pytest.mark.parametrize("suffix", ["png", "jpg", "bmp"])
def test_a_folder_is_read_as_frames(make_folder: MakeFolder, suffix: str) -> None:
    sequence = open_sequence(make_folder(color_suffix=suffix), CONFIG)
    assert (sequence.name, len(sequence), sequence.ground_truth) == ("tiny", 6, None)
    assert sequence.warnings == ()
    frames = list(sequence)
    np.testing.assert_allclose(sequence.timestamps_s, 100 + np.arange(6) / 10)
    assert [frame.timestamp_s for frame in frames] == sequence.timestamps_s.tolist()
    for i, frame in enumerate(frames):
        np.testing.assert_allclose(frame.rgb[12, 16], (i, 100, 200), atol=4)
        assert frame.depth_m[0, 0] == 0.0
        assert frame.depth_m[5, 5] == np.float32(round(5000 * (1 + i / 10)) / 5000)


def test_a_relative_path_has_its_folders_name(
    make_folder: MakeFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(make_folder())
    assert open_sequence(Path(), CONFIG).name == "tiny"


@pytest.mark.parametrize("name", ["rgb.txt", "depth.txt"])
def test_an_empty_list_is_named(make_folder: MakeFolder, name: str, fails: Fails) -> None:
    folder = make_folder()
    (folder / name).write_text("# only a comment\n\n")
    assert fails(folder, "the list names no image").endswith(name)


@pytest.mark.parametrize("line", ["100.25", "soon rgb/3.png", "nan rgb/3.png", "inf rgb/3.png"])
def test_a_malformed_line_is_named_with_its_number(
    make_folder: MakeFolder, line: str, fails: Fails
) -> None:
    folder = make_folder()
    edit(folder / "rgb.txt", lambda lines: [*lines[:3], line, *lines[3:]])
    fails(folder, f'line 4 is not "timestamp filename": {line!r}')


def test_a_list_that_is_not_text_is_named(make_folder: MakeFolder, fails: Fails) -> None:
    folder = make_folder()
    (folder / "rgb.txt").write_bytes(b"\xff\xfe\x00")
    fails(folder, "not text in UTF-8")


def test_commas_tabs_byte_order_marks_and_spaces_in_names_are_read(
    make_folder: MakeFolder,
) -> None:
    folder = make_folder()
    (folder / "rgb/2.png").rename(folder / "rgb/two words.png")
    edit(folder / "rgb.txt", lambda lines: [s.replace("2.png", "two words.png") for s in lines])
    text = (folder / "depth.txt").read_text().replace(" depth/", ",\tdepth/")
    (folder / "depth.txt").write_bytes(b"\xef\xbb\xbf" + text.replace("\n", "\r\n").encode())
    assert len(list(open_sequence(folder, CONFIG))) == 6


def test_unsorted_lists_are_sorted_and_said(make_folder: MakeFolder) -> None:
    folder = make_folder()
    edit(folder / "rgb.txt", lambda lines: lines[::-1])
    sequence = open_sequence(folder, CONFIG)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == list(range(6))
    assert sequence.warnings == ("rgb.txt is not in the order of time; it was sorted",)


def test_of_equal_times_the_first_is_used_and_said(make_folder: MakeFolder) -> None:
    folder = make_folder()
    edit(folder / "rgb.txt", lambda lines: [*lines, "100.2 rgb/5.png", lines[-1]])
    sequence = open_sequence(folder, CONFIG)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == list(range(6))
    assert sequence.warnings == (
        "rgb.txt has 1 line(s) that came before; each was used once",
        "rgb.txt is not in the order of time; it was sorted",
        "rgb.txt has 1 line(s) whose timestamp came before; the first of each was used",
    )


def test_images_without_partner_are_counted(make_folder: MakeFolder) -> None:
    folder = make_folder(10)
    edit(folder / "depth.txt", lambda lines: [*lines[:3], *lines[5:], "300.0 depth/0.png"])
    sequence = open_sequence(folder, CONFIG)
    assert len(sequence) == 8
    assert "2 of 10 colour images have no depth image within 0.02 s" in sequence.warnings[0]


def test_next_to_no_pairs_are_lists_of_two_clocks(make_folder: MakeFolder, fails: Fails) -> None:
    folder = make_folder(30)
    late = [f"{300 + k}.0 depth/{k}.png" for k in range(1, 30)]
    edit(folder / "depth.txt", lambda lines: [*lines[:2], *late])
    fails(folder, "of 30 colour and 30 depth images only 1 pair up within 0.02 s")


def test_no_pair_says_the_smallest_gap_and_the_flag(make_folder: MakeFolder, fails: Fails) -> None:
    folder = make_folder()
    tight = InputConfig(max_time_difference_s=0.003)
    said = fails(folder, "the smallest difference is 0.004 s, allowed are 0.003 s", tight)
    assert "--input.max-time-difference-s" in said


def test_ground_truth_is_poses_of_the_camera(make_folder: MakeFolder) -> None:
    folder = make_folder()
    half = np.sqrt(0.5)
    (folder / "groundtruth.txt").write_text(
        f"# truth\n100.0 1 2 3 0 0 {half} {half}\n100.1 1 2 3 0 0 7 7\n"
    )
    truth = open_sequence(folder, CONFIG).ground_truth
    assert truth is not None
    assert truth.timestamps_s.tolist() == [100.0, 100.1]
    quarter_turn = [[0, -1, 0, 1], [1, 0, 0, 2], [0, 0, 1, 3], [0, 0, 0, 1]]
    np.testing.assert_allclose(truth.T_world_cam, [quarter_turn] * 2, atol=1e-12)


@pytest.mark.parametrize(
    "gap",
    [
        "nan nan nan nan nan nan nan",
        "0 0 0 0 0 0 0",
        "0 0 inf 0 0 0 1",
        "1 0 0 0 0 0 nan",
        "1 0 0 0 0 1e200 0",
        "1e13 0 0 0 0 0 1",
        "1.#QNAN 0 0 0 0 0 -nan(ind)",
    ],
)
def test_poses_that_are_not_known_are_gaps(
    make_folder: MakeFolder, gap: str, opened: Opened
) -> None:
    folder = make_folder()
    (folder / "groundtruth.txt").write_text(
        f"100.0 1 0 0 0 0 0 1\n100.1 {gap}\n100.2 2 0 0 0 0 0 1\n"
    )
    sequence = opened(folder)
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.timestamps_s.tolist() == [100.0, 100.2]
    assert sequence.ground_truth.T_world_cam[:, 0, 3].tolist() == [1.0, 2.0]
    assert "1 of 3 poses of groundtruth.txt hold no numbers" in sequence.warnings[0]
    (folder / "groundtruth.txt").write_text(f"100.1 {gap}\n")
    assert opened(folder).ground_truth is None


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("100.1 0 0 0 0 0 1", "line 2 is not"),
        ("100.1 0 0 0 0 0 0 1 9", "line 2 is not"),
        ("100.1 x 0 0 0 0 0 1", "line 2 is not"),
        ("nan 0 0 0 0 0 0 1", "line 2 is not"),
        ("100.1 nan 0 0 0 0 1", "line 2 is not"),
        ("100.1 0 0 0 0 0 0 1e-9", "line 2 has a quaternion of length zero"),
    ],
)
def test_malformed_ground_truth_is_named_with_its_line(
    make_folder: MakeFolder, line: str, said: str, fails: Fails
) -> None:
    folder = make_folder()
    (folder / "groundtruth.txt").write_text(f"100.0 0 0 0 0 0 0 1\n{line}\n")
    assert fails(folder, said).endswith("groundtruth.txt")


def test_ground_truth_out_of_order_is_put_in_order_and_said(make_folder: MakeFolder) -> None:
    folder = make_folder()
    lines = truth_lines()
    (folder / "groundtruth.txt").write_text("\n".join([*lines[::-1], "100.2 9 9 9 0 0 0 1"]))
    sequence = open_sequence(folder, CONFIG)
    assert sequence.ground_truth is not None
    assert sequence.ground_truth.T_world_cam[:, 0, 3].tolist() == list(range(6))
    assert [warning.split(maxsplit=1)[0] for warning in sequence.warnings] == [
        "groundtruth.txt",
        "groundtruth.txt",
    ]


def test_ground_truth_without_a_pose_is_none_and_said(make_folder: MakeFolder) -> None:
    folder = make_folder()
    (folder / "groundtruth.txt").write_text("# nothing\n")
    sequence = open_sequence(folder, CONFIG)
    assert sequence.ground_truth is None
    assert "no ground truth" in sequence.warnings[0]


def test_a_camera_of_another_image_size_names_both_sizes(
    make_folder: MakeFolder, fails: Fails
) -> None:
    folder = make_folder(name="fr1_tiny")
    (folder / "camera.toml").unlink()
    said = fails(folder, "a colour image has 32x24 pixels but the camera 640x480")
    assert "--input.camera" in said


def test_a_depth_scale_that_cannot_be_right_is_a_warning(make_folder: MakeFolder) -> None:
    sequence = open_sequence(make_folder(), InputConfig(depth_scale=100.0))
    assert "--input.depth-scale 5000" in sequence.warnings[0]
    assert len(list(sequence)) == 6


@pytest.mark.skipif(not DESK.is_dir(), reason="no copy of fr1_desk under LOOPCLOSE_DATA")
def test_every_depth_image_of_fr1_desk_finds_its_colour_image() -> None:
    sequence = open_sequence(DESK, CONFIG)
    listed = [len(list(read_lines(DESK / name))) for name in ("rgb.txt", "depth.txt")]
    assert (len(sequence), *listed) == (595, 613, 595)
    assert sequence.camera.fx == 517.3
    assert sequence.ground_truth is not None
    assert len(sequence.ground_truth) == 2335
    assert sequence.warnings == ()
    np.testing.assert_array_equal(
        sequence.timestamps_s[:5],
        [
            1305031453.359684,
            1305031453.391690,
            1305031453.423683,
            1305031453.459685,
            1305031453.491698,
        ],
    )
    for i, frame in zip(range(5), sequence, strict=False):
        assert frame.timestamp_s == sequence.timestamps_s[i]
        assert frame.rgb.shape == (480, 640, 3)
        assert 0.5 < np.median(frame.depth_m[frame.depth_m > 0]) < 3.0


# Whole milliseconds: sums and differences stay exact, so "as close as" has one meaning.
stamps = st.lists(st.integers(0, 400), min_size=1, max_size=7, unique=True).map(
    lambda values: np.array(sorted(values), dtype=np.float64)
)


def best_of_all_pairings(first: np.ndarray, second: np.ndarray, limit: float) -> tuple[int, float]:
    """Try every way to pair in the order of time; return (pairs, minus total difference)."""

    @cache
    def best(i: int, k: int) -> tuple[int, float]:
        if i == len(first) or k == len(second):
            return 0, 0.0
        options = [best(i + 1, k), best(i, k + 1)]
        gap = abs(first[i] - second[k])
        if gap <= limit:
            count, cost = best(i + 1, k + 1)
            options.append((count + 1, cost - gap))
        return max(options)

    return best(0, 0)


@given(stamps, stamps, st.integers(1, 60))
def test_no_other_pairing_has_more_or_closer_pairs(
    first: np.ndarray, second: np.ndarray, limit: int
) -> None:
    pairs = associate(first, second, float(limit))
    gaps = np.abs(first[pairs[:, 0]] - second[pairs[:, 1]])
    assert (gaps <= limit).all()
    assert (np.diff(pairs, axis=0) > 0).all()
    assert (len(pairs), -gaps.sum()) == best_of_all_pairings(first, second, float(limit))


def test_no_pairs_have_the_shape_of_pairs() -> None:
    assert associate(np.array([0.0]), np.array([1.0]), 0.5).shape == (0, 2)


def test_the_closer_one_gets_the_partner() -> None:
    pairs = associate(np.array([0.0, 1.0]), np.array([0.9]), 2.0)
    assert pairs.tolist() == [[1, 0]]


def test_streams_half_a_period_out_of_step_lose_no_frame() -> None:
    first = np.arange(300) / 30.0
    jitter = np.where(np.arange(300) % 2, 0.001, -0.001)
    assert len(associate(first, first + 1 / 60 + jitter, 0.02)) == 300


def test_a_limit_longer_than_the_recording_pairs_it_all() -> None:
    first = np.arange(5000) / 30.0
    pairs = associate(first, first + 0.001, 1e9)
    assert (pairs[:, 0] == pairs[:, 1]).all()
    assert len(pairs) == 5000


@pytest.fixture
def associated(export: Export, tiny_walk: Any) -> Path:
    """Write a folder of associations.txt alone, colour first."""
    return export("associations", tiny_walk)


def rewrite(folder: Path, change: Callable[[list[str]], list[str]]) -> None:
    """Give each line of the list as its four fields, and write what comes back."""
    file = folder / "associations.txt"
    rows = [change(line.split()) for line in file.read_text().splitlines()]
    file.write_text("".join(" ".join(row) + "\n" for row in rows))


def check_walk(sequence: Sequence, walk: Any) -> None:
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(6) / 30.0)
    for i, frame in enumerate(sequence):
        assert frame.rgb[0, 0, 0] == i
        np.testing.assert_allclose(frame.depth_m, 1.0 + i / 10.0, atol=1e-6)
    assert sequence.camera == walk.camera_in(5000.0)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.T_world_cam, walk.T_world_depth)
    assert sequence.warnings == ()


def test_associated_images_come_with_camera_and_truth(
    associated: Path, tiny_walk: Any, opened: Opened
) -> None:
    check_walk(opened(associated), tiny_walk)


def test_depth_may_come_first_whatever_its_folder_is_called(
    associated: Path, tiny_walk: Any, opened: Opened
) -> None:
    rewrite(associated, lambda row: [*row[2:], *row[:2]])
    check_walk(opened(associated), tiny_walk)
    (associated / "depth").rename(associated / "d")
    rewrite(associated, lambda row: [row[0], row[1].replace("depth", "d"), *row[2:]])
    check_walk(opened(associated), tiny_walk)


def test_the_folders_name_tells_depth_where_the_first_images_do_not(
    associated: Path, opened: Opened, fails: Fails
) -> None:
    colour_only = cv2.imread(str(associated / "rgb/0.png"))
    cv2.imwrite(str(associated / "depth/0.png"), colour_only)
    rewrite(associated, lambda row: [*row[2:], *row[:2]])
    fails(associated, "a depth image has 3 channel(s) of uint8")
    (associated / "depth").rename(associated / "d")
    rewrite(associated, lambda row: [row[0], row[1].replace("depth", "d"), *row[2:]])
    said = fails(associated, "which image of a line is depth is not known: neither 0.png nor 0.png")
    assert said.endswith("associations.txt")


def test_the_time_of_an_associated_frame_is_the_colour_images(
    associated: Path, opened: Opened
) -> None:
    rewrite(associated, lambda row: [row[0], row[1], str(float(row[2]) + 0.011), row[3]])
    np.testing.assert_allclose(opened(associated).timestamps_s, np.arange(6) / 30.0)


def test_associated_images_are_sorted_and_the_missing_skipped(
    associated: Path, opened: Opened
) -> None:
    lines = (associated / "associations.txt").read_text().splitlines()
    (associated / "associations.txt").write_text("\n".join(["# pairs", *lines[::-1]]))
    (associated / "depth/0.png").unlink()
    cut = associated / "rgb/3.png"
    cut.write_bytes(cut.read_bytes()[:-20])
    sequence = opened(associated)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == [1, 2, 4, 5]
    assert sequence.warnings[0] == "associations.txt is not in the order of time; it was sorted"


def test_associated_images_of_an_unknown_camera_are_refused(associated: Path, fails: Fails) -> None:
    (associated / "camera.toml").unlink()
    fails(associated, "which camera made this sequence is not known")


def test_without_poses_associated_images_have_no_truth(associated: Path, opened: Opened) -> None:
    (associated / "groundtruth.txt").unlink()
    assert opened(associated).ground_truth is None


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "the list names no image"),
        ("# rgb depth\n", "the list names no image"),
        ("0.1 rgb/1.png 0.1\n", 'line 1 is not "time image time image"'),
        ("0.1 rgb/1.png 0.1 depth/1.png 4\n", 'line 1 is not "time image time image"'),
        ("0.1 rgb/1.png soon depth/1.png\n", 'line 1 is not "time image time image"'),
        ("nan rgb/1.png 0.1 depth/1.png\n", 'line 1 is not "time image time image"'),
        ("'0.1;0.2' rgb/1.png 0.1 depth/1.png\n", 'line 1 is not "time image time image"'),
    ],
)
def test_an_association_list_that_is_wrong_is_named(
    associated: Path, text: str, said: str, fails: Fails
) -> None:
    (associated / "associations.txt").write_text(text)
    assert fails(associated, said).endswith("associations.txt")


def stamped(folder: Path, stamp: Callable[[int], str], *names: str) -> None:
    """Give line i of the lists, comments apart, another time."""
    for name in names or ("rgb.txt", "depth.txt"):
        rows = [
            line.split() for line in (folder / name).read_text().splitlines() if "#" not in line
        ]
        lines = [" ".join([stamp(i), *row[1:]]) for i, row in enumerate(rows)]
        (folder / name).write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("per_s", [1e3, 1e6, 1e9])
def test_lists_in_another_unit_are_read_in_seconds_and_said(
    make_folder: MakeFolder, per_s: float
) -> None:
    folder = make_folder()
    (folder / "groundtruth.txt").write_text("\n".join(truth_lines()))
    stamped(folder, lambda i: f"{(100 + i / 10) * per_s:.0f}", "rgb.txt", "groundtruth.txt")
    sequence = open_sequence(folder, CONFIG)
    np.testing.assert_allclose(sequence.timestamps_s, 100 + np.arange(6) / 10)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.timestamps_s, 100 + np.arange(6) / 10)
    assert [warning.split(" ", 1)[0] for warning in sequence.warnings] == ["rgb.txt", "the"]


def test_lists_of_numbers_are_taken_at_30_a_second(make_folder: MakeFolder) -> None:
    folder = make_folder()
    (folder / "groundtruth.txt").write_text("\n".join(truth_lines()))
    stamped(folder, str, "rgb.txt", "depth.txt", "groundtruth.txt")
    sequence = open_sequence(folder, CONFIG)
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(6) / 30)
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.timestamps_s, np.arange(6) / 30)
    assert sum("numbers of" in warning for warning in sequence.warnings) == 3


def test_a_clock_that_starts_again_makes_two_sessions(make_folder: MakeFolder) -> None:
    folder = make_folder(16)
    (folder / "groundtruth.txt").write_text("\n".join(truth_lines(16)))
    lists = ("rgb.txt", "depth.txt", "groundtruth.txt")
    stamped(folder, lambda i: f"{i % 8 / 10 + 0.015 * (i >= 8):.4f}", *lists)
    sequence = open_sequence(folder, CONFIG)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == list(range(16))
    assert sequence.ground_truth is not None
    np.testing.assert_allclose(sequence.ground_truth.timestamps_s, sequence.timestamps_s)
    np.testing.assert_array_equal(sequence.ground_truth.T_world_cam[:, 0, 3], range(16))
    first, second = sequence.sessions()
    assert [frame.rgb[0, 0, 0] for frame in second] == list(range(8, 16))
    assert first.timestamps_s.tolist() == (np.arange(8) / 10).tolist()
    assert first.timestamps_s[-1] + 9.0 < second.timestamps_s[0]
    assert first.warnings == sequence.warnings and second.warnings == ()
    assert (first.name, second.name) == ("tiny, session 1", "tiny, session 2")


def test_one_clock_that_starts_again_and_one_that_does_not_are_refused(
    make_folder: MakeFolder, fails: Fails
) -> None:
    folder = make_folder(16)
    stamped(folder, lambda i: f"{i % 8 / 10:.4f}", "rgb.txt")
    fails(folder, "the clock of depth.txt starts again 0 time(s), that of the images 1 time(s)")


def test_a_recording_of_one_clock_is_one_session(make_folder: MakeFolder) -> None:
    sequence = open_sequence(make_folder(), CONFIG)
    assert sequence.sessions() == [sequence]


@pytest.mark.parametrize("stamp", [lambda i: str(i // 4), lambda i: "1.30503e+09"])
def test_times_that_were_rounded_are_refused(
    make_folder: MakeFolder, stamp: Callable[[int], str], fails: Fails
) -> None:
    folder = make_folder(8)
    stamped(folder, stamp)
    fails(folder, "of 8 lines have the time of another, as if times had been rounded")


def test_associations_are_read_as_other_tools_write_them(
    associated: Path, tiny_walk: Any, opened: Opened
) -> None:
    rewrite(associated, lambda row: [f'"{field}";' for field in row])
    check_walk(opened(associated), tiny_walk)
    text = (associated / "associations.txt").read_text().replace("/", "\\")
    (associated / "associations.txt").write_text("time rgb time depth\n" + text)
    check_walk(opened(associated), tiny_walk)


def test_associations_may_count_the_images(associated: Path, opened: Opened) -> None:
    rewrite(associated, lambda row: [str(round(30 * float(row[0]))), row[1], "7", row[3]])
    sequence = opened(associated)
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(6) / 30.0)
    assert "numbers of images, 30 a second" in sequence.warnings[0]


def test_an_associated_image_may_lie_elsewhere(associated: Path, opened: Opened) -> None:
    rewrite(associated, lambda row: [row[0], str(associated / row[1]), row[2], row[3]])
    assert len(opened(associated)) == 6
