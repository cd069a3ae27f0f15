# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.geometry import se3
from slam.mapping.keyframe_links import covisible_links
from slam.mapping.landmark_map import LandmarkMap, empty_pairs
from slam.types import Keyframe


@pytest.fixture
def tied(make_scene):
    """Return what ties two keyframes, the first of which a camera took: None, the map's."""
    scene = make_scene()

    def link(camera):
        the_map = LandmarkMap(scene.camera, 8, 64)
        the_map.add_keyframe(scene.features[0], scene.T_world_cam[0], empty_pairs())
        ids = the_map.add_landmarks(0)
        the_map.add_keyframe(scene.features[1], scene.T_world_cam[1], np.column_stack([ids, ids]))
        ref, new = (
            Keyframe(k, float(k), scene.T_world_cam[k], scene.features[k], None) for k in (0, 1)
        )
        (found,) = covisible_links(the_map, new, [replace(ref, camera=camera)], np.eye(6))
        np.testing.assert_allclose(
            found.motion.T_ref_query, se3.inverse(scene.T_world_cam[0]) @ scene.T_world_cam[1]
        )
        return np.trace(found.motion.information)

    return link


def test_two_cameras_are_tied_less_firmly_than_one(tied, make_scene):
    camera = make_scene().camera
    assert tied(None) == tied(camera) > 2.0 * tied(replace(camera, cx=camera.cx + 1.0))
