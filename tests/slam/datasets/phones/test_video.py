# SPDX-License-Identifier: Apache-2.0
import random
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import cv2
import numpy as np
import pytest

from placerec.datasets.images import BrokenImage
from slam.datasets.phones.video import Video
from slam.types import SlamError

COUNT = 90
BITS = 7


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a video whose frames carry their number in black and white bars."""
    path = tmp_path_factory.mktemp("video") / "rgb.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (16 * BITS, 32))
    for i in range(COUNT):
        bars = [255 * (i >> bit & 1) for bit in range(BITS)]
        writer.write(np.tile(np.repeat(bars, 16)[None, :, None], (32, 1, 3)).astype(np.uint8))
    writer.release()
    return path


def number(image: np.ndarray | BrokenImage) -> int:
    assert not isinstance(image, BrokenImage)
    return sum(int(image[16, 16 * bit + 8, 0] > 128) << bit for bit in range(BITS))


def test_a_video_says_how_much_it_holds(file: Path) -> None:
    video = Video(file)
    assert (video.count, video.width, video.height) == (COUNT, 16 * BITS, 32)


def test_frames_come_in_order_more_than_once_and_with_gaps(file: Path) -> None:
    video = Video(file)
    for step in (1, 1, 3, 7):
        wanted = list(range(0, COUNT, step))
        assert [number(video.frame(i)) for i in wanted] == wanted


def test_any_frame_can_be_asked_for(file: Path) -> None:
    video, wanted = Video(file), [*range(COUNT)] * 2
    random.Random(0).shuffle(wanted)
    assert [number(video.frame(i)) for i in wanted] == wanted


def test_order_is_not_lost_to_a_look_elsewhere(file: Path) -> None:
    video = Video(file)
    for i in range(COUNT):
        assert number(video.frame(i)) == i
        if i == 10:
            assert number(video.frame(80)) == 80
    assert video._next == COUNT


def test_threads_get_the_frames_they_ask_for(file: Path) -> None:
    video = Video(file)
    with ThreadPoolExecutor(4) as readers:
        assert [number(each) for each in readers.map(video.frame, range(COUNT))] == [*range(COUNT)]


def test_red_is_first(tmp_path: Path) -> None:
    path = tmp_path / "rgb.mp4"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 30.0, (64, 32))
    writer.write(np.full((32, 64, 3), (20, 60, 230), np.uint8))
    writer.release()
    frame = Video(path).frame(0)
    assert not isinstance(frame, BrokenImage)
    np.testing.assert_allclose(frame[16, 32].astype(int), [230, 60, 20], atol=6)


def test_a_frame_behind_the_end_is_broken(file: Path) -> None:
    broken = Video(file).frame(COUNT)
    assert isinstance(broken, BrokenImage)
    assert broken.path == file / "000090"


@pytest.mark.parametrize("content", [b"", b"no video at all"])
def test_what_is_no_video_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "rgb.mp4").write_bytes(content)
    with pytest.raises(SlamError, match=r"the video cannot be opened.*rgb\.mp4"):
        Video(tmp_path / "rgb.mp4")
