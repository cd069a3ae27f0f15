# SPDX-License-Identifier: Apache-2.0
import re
import threading
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from placerec.datasets.images import BrokenImage
from slam.datasets import Sequence
from slam.datasets.sequence import ImagePair
from slam.types import Frame, SlamError

MakeFolder = Callable[..., Path]
Opened = Callable[[Path], Sequence]


def reader_threads() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name.startswith("images")]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-20])


def red(sequence: Sequence) -> list[int]:
    return [int(frame.rgb[0, 0, 0]) for frame in sequence]


def test_frames_come_in_order_each_time(make_folder: MakeFolder, opened: Opened) -> None:
    sequence = opened(make_folder(40))
    assert red(sequence) == list(range(40))
    assert red(sequence) == list(range(40))
    assert reader_threads() == []


@pytest.mark.parametrize("count", [1, 2, 4, 5, 6])
def test_short_sequences_come_whole(make_folder: MakeFolder, count: int, opened: Opened) -> None:
    assert red(opened(make_folder(count))) == list(range(count))


def test_a_frame_can_be_read_alone(make_folder: MakeFolder, opened: Opened) -> None:
    sequence = opened(make_folder())
    frame = sequence.frame(4)
    assert (frame.timestamp_s, frame.rgb[0, 0, 0]) == (sequence.timestamps_s[4], 4)


def test_a_loop_left_early_leaves_no_thread(make_folder: MakeFolder, opened: Opened) -> None:
    for _frame in opened(make_folder(40)):
        break
    assert reader_threads() == []


def test_an_interrupted_loop_leaves_no_thread(make_folder: MakeFolder, opened: Opened) -> None:
    def interrupted(sequence: Sequence) -> None:
        for _frame in sequence:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted(opened(make_folder(40)))
    assert reader_threads() == []


def test_a_few_frames_are_read_ahead(
    make_folder: MakeFolder, monkeypatch: pytest.MonkeyPatch, opened: Opened
) -> None:
    sequence = opened(make_folder(40))
    started: list[float] = []
    fifth_was_read = threading.Event()
    read = sequence._read

    def recording(pair: ImagePair) -> Frame | BrokenImage:
        started.append(pair.timestamp_s)
        if len(started) == 5:
            fifth_was_read.set()
        return read(pair)

    monkeypatch.setattr(sequence, "_read", recording)
    frames = iter(sequence)
    next(frames)
    assert fifth_was_read.wait(timeout=20.0)
    del frames
    assert sorted(started) == sequence.timestamps_s[:5].tolist()


def test_a_missing_file_is_left_out_from_the_start(make_folder: MakeFolder, opened: Opened) -> None:
    folder = make_folder()
    (folder / "depth/2.png").unlink()
    sequence = opened(folder)
    assert len(sequence) == 5
    assert len(sequence.timestamps_s) == 5
    assert sequence.skipped == [(folder / "depth/2.png", "the file is missing")]
    assert "1 of 6 frames were skipped" in sequence.warnings[0]
    assert red(sequence) == [0, 1, 3, 4, 5]


def test_a_broken_image_is_skipped_once_and_recorded(
    make_folder: MakeFolder, capfd: pytest.CaptureFixture[str], opened: Opened
) -> None:
    folder = make_folder()
    cut(folder / "rgb/1.png")
    cut(folder / "depth/3.png")
    sequence = opened(folder)
    for _ in range(2):
        assert red(sequence) == [0, 2, 4, 5]
        assert sequence.skipped == [
            (folder / "rgb/1.png", "the file is cut off"),
            (folder / "depth/3.png", "the file is cut off"),
        ]
    assert "2 of 6 frames were skipped" in sequence.warnings[-1]
    assert capfd.readouterr().err == ""
    with pytest.raises(SlamError, match="frame 1 cannot be read: the file is cut off"):
        sequence.frame(1)


def test_half_of_the_frames_may_be_missing_but_not_more(
    make_folder: MakeFolder, opened: Opened
) -> None:
    folder = make_folder()
    for i in range(3):
        (folder / f"rgb/{i}.png").unlink()
    assert red(opened(folder)) == [3, 4, 5]
    (folder / "depth/4.png").unlink()
    with pytest.raises(SlamError, match="more than half of the 6 frames"):
        opened(folder)


def test_more_than_half_broken_is_an_error_as_soon_as_it_is_certain(
    make_folder: MakeFolder, opened: Opened
) -> None:
    folder = make_folder(8)
    (folder / "rgb/0.png").unlink()
    for i in range(1, 5):
        cut(folder / f"depth/{i}.png")
    frames = iter(opened(folder))
    with pytest.raises(SlamError, match="more than half of the 8 frames"):
        next(frames)


def test_depth_of_another_size_names_both_sizes_and_the_file(
    make_folder: MakeFolder, opened: Opened
) -> None:
    folder = make_folder(40)
    odd = folder / "depth/7.png"
    cv2.imwrite(str(odd), np.full((12, 16), 5000, np.uint16))
    frames = iter(opened(folder))
    said = "a depth image has 16x12 pixels but its colour image 32x24"
    with pytest.raises(SlamError, match=re.escape(said)) as caught:
        list(frames)
    assert str(caught.value).endswith(str(odd))
    assert reader_threads() == []


def test_depth_of_another_kind_is_found_at_once(make_folder: MakeFolder, opened: Opened) -> None:
    folder = make_folder()
    cv2.imwrite(str(folder / "depth/0.png"), np.zeros((24, 32), np.uint8))
    with pytest.raises(SlamError, match="uint8"):
        opened(folder)


def test_mostly_missing_depth_is_a_warning(make_folder: MakeFolder, opened: Opened) -> None:
    folder = make_folder(2)
    for i in range(2):
        cv2.imwrite(str(folder / f"depth/{i}.png"), np.zeros((24, 32), np.uint16))
    assert "100% of the depth pixels" in opened(folder).warnings[0]


def test_colour_of_12_bits_in_16_is_seen_and_said(make_folder: MakeFolder, opened: Opened) -> None:
    folder = make_folder()
    for i in range(6):
        light = np.full((24, 32), 16 * (100 + i), np.uint16)
        light[0, 0] = 4000
        cv2.imwrite(str(folder / f"rgb/{i}.png"), light)
    sequence = opened(folder)
    assert [frame.rgb[5, 5, 0] for frame in sequence] == [100 + i for i in range(6)]
    assert sequence.warnings == ("the colour images use 12 of their 16 bits",)


def test_depth_in_floating_point_metres_needs_no_scale_and_is_said(
    make_folder: MakeFolder, opened: Opened
) -> None:
    folder = make_folder()
    for i in range(6):
        np.save(folder / f"depth/{i}.npy", np.full((24, 32), 1.0 + i / 10, np.float32))
    listed = (folder / "depth.txt").read_text().replace(".png", ".npy")
    (folder / "depth.txt").write_text(listed)
    sequence = opened(folder)
    assert sequence.camera.depth_scale == 1.0
    for i, frame in enumerate(sequence):
        np.testing.assert_allclose(frame.depth_m, 1.0 + i / 10, atol=1e-6)
    (said,) = sequence.warnings
    assert "floating-point numbers" in said and "5000" in said
