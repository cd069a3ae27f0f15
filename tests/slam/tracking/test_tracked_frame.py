# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.tracking.tracked_frame import preview
from slam.types import Frame


def frame_of(rgb, depth_m):
    return Frame(7.0, np.asarray(rgb, np.uint8), np.asarray(depth_m, np.float32))


def test_colour_is_averaged_without_overflow_and_depth_is_picked():
    rgb = np.zeros((2, 4, 3))
    rgb[:, :2] = [[[255, 255, 0], [255, 0, 0]], [[255, 255, 0], [255, 0, 0]]]
    small = preview(frame_of(rgb, [[1.0, 2.0, 0.0, 4.0], [5.0, 6.0, 7.0, 8.0]]))
    assert small.rgb.tolist() == [[[255, 127, 0], [0, 0, 0]]]
    # A mean of depths on both sides of an edge would be a point that is on neither.
    assert small.depth_m.tolist() == [[1.0, 0.0]]
    assert small.timestamp_s == 7.0
    assert small.rgb.dtype == np.uint8 and small.depth_m.dtype == np.float32


@pytest.mark.parametrize("shape", [(5, 7), (4, 7), (5, 6)])
def test_an_odd_last_row_or_column_is_left_out_of_both(shape):
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    depth_m = 10.0 * rows + columns
    small = preview(frame_of(np.repeat(depth_m[:, :, None], 3, axis=2), depth_m))
    assert small.rgb.shape == (2, 3, 3)
    assert small.depth_m.tolist() == [[0.0, 2.0, 4.0], [20.0, 22.0, 24.0]]


def test_a_preview_does_not_keep_the_large_frame_alive():
    depth_m = np.ones((4, 4), np.float32)
    small = preview(Frame(0.0, np.zeros((4, 4, 3), np.uint8), depth_m))
    depth_m[:] = 9.0
    assert (small.depth_m == 1.0).all() and small.depth_m.base is None
