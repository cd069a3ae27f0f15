# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.tracking.frame_checks import check_frame
from slam.types import Camera, Frame, SlamError

CAMERA = Camera(8, 6, 4.0, 4.0, 3.5, 2.5)


def frame(timestamp_s=1.0, rgb=(6, 8, 3), depth=(6, 8), dtype=np.uint8):
    return Frame(timestamp_s, np.zeros(rgb, dtype), np.zeros(depth, np.float32))


def test_a_frame_of_the_camera_in_the_order_of_time_is_let_in():
    check_frame(frame(), CAMERA, last_s=0.999)


@pytest.mark.parametrize(
    ("refused", "said"),
    [
        (frame(timestamp_s=0.5), "order of time: 0.500000 s after 0.500000 s"),
        (frame(timestamp_s=np.nan), "order of time"),
        (frame(timestamp_s=np.inf), "order of time"),
        (frame(rgb=(5, 8, 3)), r"colour \(5, 8, 3\)"),
        (frame(rgb=(6, 8)), r"colour \(6, 8\)"),
        (frame(depth=(6, 7)), r"depth \(6, 7\)"),
        (frame(dtype=np.float64), "float64 colours, not uint8"),
    ],
)
def test_any_other_is_refused_in_one_line(refused, said):
    with pytest.raises(SlamError, match=said) as error:
        check_frame(refused, CAMERA, last_s=0.5)
    assert "\n" not in str(error.value)
