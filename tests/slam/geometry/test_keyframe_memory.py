# SPDX-License-Identifier: Apache-2.0
import copy
import errno
import gc
import os
import pickle
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slam.geometry.keyframe_memory import KeyframeMemory, full_size
from slam.tracking.tracked_frame import preview
from slam.types import Features, Frame, SlamError

UNITS = 5000.0
PLENTY = 1 << 30


@pytest.fixture(scope="module")
def shown(frames):
    return [preview(each) for each in frames[:4]]


def assert_same(kept, frame):
    assert isinstance(kept, Frame)
    assert kept.timestamp_s == frame.timestamp_s
    assert kept.rgb.dtype == np.uint8 and kept.rgb.shape == frame.rgb.shape
    assert np.abs(kept.rgb.astype(float) - frame.rgb).mean() < 5.0
    assert kept.depth_m.dtype == np.float32
    np.testing.assert_array_equal(kept.depth_m, frame.depth_m)


def open_files():
    gc.collect()
    return len(list(Path("/proc/self/fd").iterdir()))


@pytest.mark.parametrize("most_bytes", [PLENTY, 0], ids=["memory", "file"])
def test_a_frame_that_was_kept_is_the_frame_again(shown, tmp_path, most_bytes):
    store = KeyframeMemory(most_bytes, UNITS, tmp_path)
    kept = [store.keep_image(each) for each in shown]
    for again, frame in zip(kept, shown, strict=True):
        assert_same(again, frame)
        assert_same(again, frame)  # as often as anybody asks


def test_a_small_image_is_enlarged_to_what_it_was_of(frames, shown):
    enlarged = full_size(shown[0].rgb, (241, 321))  # of odd sizes the last row was left out
    assert enlarged.shape == (241, 321, 3) and enlarged.dtype == np.uint8
    same = full_size(shown[0].rgb, (240, 320)).astype(float)
    assert np.abs(same - frames[0].rgb).mean() < 0.5 * np.abs(same - frames[20].rgb).mean()


def test_it_takes_a_fifth_of_the_memory(shown, tmp_path):
    most_bytes = (shown[0].rgb.nbytes + shown[0].depth_m.nbytes) // 5
    kept = KeyframeMemory(most_bytes, UNITS, tmp_path / "none").keep_image(
        shown[0]
    )  # there can be no file
    assert_same(kept, shown[0])


@pytest.mark.parametrize(
    "depth_m",
    [
        np.full((5, 7), 1.00007, np.float32),  # between two units
        np.full((5, 7), 40.0, np.float32),  # more units than 16 bits count
        np.array([[0.0, np.nan, np.inf, 1.0]], np.float32),
        np.linspace(0.0, 3.0, 99, dtype=np.float32).reshape(9, 11)[::2, ::2],
    ],
)
def test_depth_that_is_no_whole_number_of_units_is_kept_to_the_last_bit(depth_m):
    frame = Frame(1.0, np.zeros((*depth_m.shape, 3), np.uint8), depth_m)
    np.testing.assert_array_equal(KeyframeMemory(PLENTY, UNITS).keep_image(frame).depth_m, depth_m)


def test_what_does_not_fit_into_memory_is_the_same_from_a_file(shown, tmp_path):
    inside, beyond = KeyframeMemory(PLENTY, UNITS), KeyframeMemory(10_000, UNITS, tmp_path)
    for frame in shown:
        one, other = inside.keep_image(frame), beyond.keep_image(frame)
        np.testing.assert_array_equal(one.rgb, other.rgb)
        np.testing.assert_array_equal(one.depth_m, other.depth_m)


def test_the_file_begins_where_memory_ends(shown, tmp_path):
    before = open_files()
    store = KeyframeMemory(PLENTY, UNITS, tmp_path)
    kept = store.keep_image(shown[0])
    assert open_files() == before
    store = KeyframeMemory(2, UNITS, tmp_path)
    kept = store.keep_image(shown[0])
    assert open_files() == before + 1
    assert kept.rgb.any()


def test_the_file_has_no_name_and_is_gone_with_the_last_frame(shown, tmp_path):
    before = open_files()
    store = KeyframeMemory(0, UNITS, tmp_path)
    kept = [store.keep_image(each) for each in shown]
    assert list(tmp_path.iterdir()) == []
    del store
    gc.collect()
    assert_same(kept[-1], shown[-1])
    del kept
    assert open_files() == before


def test_a_folder_that_is_removed_meanwhile_takes_nothing_away(shown, tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    store = KeyframeMemory(0, UNITS, folder)
    kept = [store.keep_image(shown[0])]
    folder.rmdir()
    kept.append(store.keep_image(shown[1]))
    for again, frame in zip(kept, shown[:2], strict=True):
        assert_same(again, frame)


def test_a_full_disk_is_one_clear_line_and_costs_nothing_that_was_kept(
    shown, tmp_path, monkeypatch
):
    store = KeyframeMemory(0, UNITS, tmp_path)
    kept = store.keep_image(shown[0])

    def full(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", full)
        with pytest.raises(SlamError, match=r"No space left.*keyframes\.memory-mb") as error:
            store.keep_image(shown[1])
    assert "\n" not in str(error.value)
    assert_same(kept, shown[0])
    assert_same(store.keep_image(shown[1]), shown[1])  # once there is space again


def test_a_file_that_takes_a_part_at_a_time_is_written_whole(shown, tmp_path, monkeypatch):
    write = os.pwrite
    monkeypatch.setattr(os, "pwrite", lambda file, data, at: write(file, data[:1000], at))
    store = KeyframeMemory(0, UNITS, tmp_path)
    kept = [store.keep_image(each) for each in shown]
    for again, frame in zip(kept, shown, strict=True):
        assert_same(again, frame)


def test_a_folder_that_is_not_there_is_one_clear_line(shown, tmp_path):
    with pytest.raises(SlamError, match="cannot keep what keyframes show: No such file"):
        KeyframeMemory(0, UNITS, tmp_path / "none").keep_image(shown[0])


def test_a_copy_is_a_frame_like_any_other(shown, tmp_path):
    again = copy.deepcopy(KeyframeMemory(0, UNITS, tmp_path).keep_image(shown[0]))
    assert type(again) is Frame
    assert_same(again, shown[0])


@pytest.fixture
def features(make_scene):
    seen = make_scene().features[0]
    return replace(seen, depth_m=seen.depth_m.astype(np.float32), octaves=np.uint8(seen.octaves))


@pytest.mark.parametrize("most_bytes", [0, 1 << 30])
def test_features_are_the_same_in_memory_and_in_a_file(features, tmp_path, most_bytes):
    kept = KeyframeMemory(most_bytes, UNITS, tmp_path).keep_features(features)
    assert isinstance(kept, Features) and (kept is features) == (most_bytes > 0)
    for each in (kept, pickle.loads(pickle.dumps(kept))):
        for name, values in vars(features).items():
            again = getattr(each, name)
            np.testing.assert_array_equal(again, values)
            assert again.dtype == values.dtype and again.flags.writeable


@pytest.fixture
def reads(monkeypatch):
    """Return a list that grows with every read of a file."""
    made, pread = [], os.pread
    monkeypatch.setattr(os, "pread", lambda *asked: made.append(asked) or pread(*asked))
    return made


def test_what_two_keyframes_show_is_read_once_while_they_are_compared(features, tmp_path, reads):
    memory = KeyframeMemory(0, UNITS, tmp_path)
    one, other, third = (memory.keep_features(features) for _ in range(3))
    for name in vars(features):
        assert getattr(one, name) is getattr(one, name)
        getattr(other, name)
    assert len(reads) == 2
    assert third.pixels is not one.pixels and len(reads) == 4  # for only two stay


def test_the_file_is_gone_with_the_last_features_too(features, tmp_path):
    before = open_files()
    kept = KeyframeMemory(0, UNITS, tmp_path).keep_features(features)
    assert kept.pixels.any() and open_files() == before + 1
    del kept
    assert open_files() == before


def test_kept_features_can_be_replaced_in_part(features, tmp_path):
    kept = KeyframeMemory(0, UNITS, tmp_path).keep_features(features)
    other = replace(kept, points_m=2.0 * kept.points_m)
    np.testing.assert_array_equal(other.points_m, 2.0 * features.points_m)
    np.testing.assert_array_equal(other.descriptors, features.descriptors)
    with pytest.raises(AttributeError, match="keypoints"):
        _ = other.keypoints


def test_a_view_without_features_is_kept_too(features, tmp_path):
    nothing = replace(features, **{name: values[:0] for name, values in vars(features).items()})
    kept = KeyframeMemory(0, UNITS, tmp_path).keep_features(nothing)
    assert kept.descriptors.shape == (0, 32) and kept.points_m.shape == (0, 3)


def test_any_thread_may_read_while_one_keeps(features, tmp_path):
    memory, kept = KeyframeMemory(0, UNITS, tmp_path), []

    def read(seed):
        rng = np.random.default_rng(seed)
        while len(kept) < 200:
            number = int(rng.integers(max(1, len(kept))))
            if number < len(kept):
                assert (kept[number].depth_m == number).all()
                assert (kept[number].descriptors == features.descriptors).all()

    with ThreadPoolExecutor(3) as pool:
        reading = [pool.submit(read, seed) for seed in range(3)]
        for number in range(200):
            depth_m = np.full_like(features.depth_m, number)
            kept.append(memory.keep_features(replace(features, depth_m=depth_m)))
        for each in reading:
            each.result()


def test_once_something_went_to_the_file_all_that_comes_later_does(features, shown, tmp_path):
    memory = KeyframeMemory(100, UNITS, tmp_path)
    assert memory.keep_features(features) is not features
    small = replace(features, **{name: values[:1] for name, values in vars(features).items()})
    assert memory.keep_features(small) is not small
    assert_same(memory.keep_image(shown[0]), shown[0])


def test_features_stay_in_memory_where_there_can_be_no_file(features, tmp_path):
    assert KeyframeMemory(0, UNITS, tmp_path / "none").keep_features(features) is features


@pytest.mark.parametrize("kind", [np.float16, np.float64])
def test_depth_of_another_kind_is_kept_in_metres(frames, tmp_path, kind):
    frame = frames[0]
    other = Frame(frame.timestamp_s, frame.rgb, frame.depth_m.astype(kind))
    kept = KeyframeMemory(PLENTY, UNITS, tmp_path).keep_image(preview(other))
    np.testing.assert_allclose(kept.depth_m, preview(frame).depth_m, rtol=1e-3)
