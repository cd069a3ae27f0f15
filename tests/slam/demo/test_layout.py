# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from slam.demo.layout import furnished_room, wall_frame

SIZE_M = (5.0, 4.0, 2.6)


@pytest.mark.parametrize("seed", range(4))
def test_furniture_stays_inside_and_leaves_the_middle_free(seed):
    panels = furnished_room(np.random.default_rng(seed), *SIZE_M)
    for panel in panels[3:]:  # after floor, rug and ceiling
        corners = panel.corner_m + np.array(
            [0 * panel.right_m, panel.right_m, panel.down_m, panel.right_m + panel.down_m]
        )
        assert (np.abs(corners[:, :2]) < np.array(SIZE_M[:2]) / 2 + 0.1).all()
        assert (corners[:, 2] > -0.01).all() and (corners[:, 2] < SIZE_M[2] + 0.01).all()
        to_wall_m = (np.array(SIZE_M[:2]) / 2 - np.abs(corners[:, :2])).min(axis=1)
        assert (to_wall_m < 0.9).all()


@pytest.mark.parametrize("azimuth_deg", [0, 90, 180, 270])
def test_a_wall_frame_faces_the_room(azimuth_deg):
    T_world_wall = wall_frame(np.radians(azimuth_deg), 2.0)
    assert np.allclose(T_world_wall[:3, :3] @ T_world_wall[:3, :3].T, np.eye(3))
    assert np.isclose(np.linalg.det(T_world_wall[:3, :3]), 1.0)
    assert np.allclose(T_world_wall @ [0, 0, 2.0, 1], [0, 0, 0, 1])
    assert np.allclose(T_world_wall[:3, 1], [0, 0, 1])
