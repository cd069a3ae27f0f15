# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.config import Config, GraphConfig
from slam.geometry import se3
from slam.tracking.given_poses import GivenPoses
from slam.types import Camera, Frame

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
CONFIG = Config(graph=GraphConfig(outside_rotation_sigma_deg=2.0, outside_translation_sigma_m=0.05))
RGB = np.random.default_rng(0).integers(0, 256, (120, 160, 3), dtype=np.uint8)
TURNED = se3.exp(np.array([0.0, 0.3, 0.0, 0.1, 0.2, 0.3]))


def frame_at(timestamp_s):
    return Frame(timestamp_s, RGB, np.full((120, 160), 2.0, dtype=np.float32))


@pytest.fixture
def given():
    return GivenPoses(CAMERA, CONFIG)


def test_every_frame_becomes_a_keyframe_linked_to_the_one_before(given):
    T_start = se3.exp(np.array([0.1, 0.0, 0.0, 5.0, 0.0, 0.0]))
    first = given.track(frame_at(10.0), T_start)
    second = given.track(frame_at(10.5), T_start @ TURNED)
    assert first.links == ()
    for number, tracked in enumerate((first, second)):
        keyframe = tracked.new_keyframe
        assert tracked.keyframe_id == keyframe.id == number and keyframe.segment == 0
        assert keyframe.timestamp_s == keyframe.preview.timestamp_s == 10.0 + 0.5 * number
        assert len(keyframe.features.pixels) > 20
        np.testing.assert_array_equal(tracked.T_kf_cam, np.eye(4))
    np.testing.assert_array_equal(second.new_keyframe.T_odom_cam, T_start @ TURNED)
    assert first.new_keyframe.turning_rad_s == 0.0
    assert second.new_keyframe.turning_rad_s == pytest.approx(0.6)
    (link,) = second.links
    assert (link.ref_id, link.query_id) == (0, 1)
    np.testing.assert_allclose(link.motion.T_ref_query, TURNED, atol=1e-12)
    sigma = 1.0 / np.sqrt(np.diag(link.motion.information))
    np.testing.assert_allclose(sigma, [np.radians(2.0)] * 3 + [0.05] * 3)
    assert np.count_nonzero(link.motion.information) == 6


def test_another_session_is_another_segment_and_begins_without_a_link(given):
    given.start_session()  # of nothing yet
    segments, links = [], []
    for _ in range(2):
        for k in range(2):
            tracked = given.track(frame_at(float(k)), np.eye(4))
            segments.append(tracked.new_keyframe.segment)
            links.append([(link.ref_id, link.query_id) for link in tracked.links])
        given.start_session()
        given.start_session()
    assert segments == [0, 0, 1, 1]
    assert links == [[], [(0, 1)], [], [(2, 3)]]
