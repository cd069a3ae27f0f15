# SPDX-License-Identifier: Apache-2.0
import numpy as np

from slam.demo.panels import Panel, light

WHITE = np.full((64, 64, 3), 255, np.uint8)
FLOOR = Panel(np.array([-1.0, 1, 0]), np.array([2.0, 0, 0]), np.array([0, -2.0, 0]), WHITE)
LAMP_M = np.array([[0.0, 0.0, 1.5]])


def lit(panels):
    return light(panels, LAMP_M, np.random.default_rng(0))[0].texture[..., 0].astype(float)


def test_light_fades_away_from_the_lamp():
    floor = lit([FLOOR])
    assert floor[32, 32] > 1.2 * floor[0, 0]


def test_a_board_before_the_lamp_throws_a_shadow_with_a_soft_edge():
    board = Panel(np.array([-0.3, 0.3, 0.75]), np.array([0.6, 0, 0]), np.array([0, -0.6, 0]), WHITE)
    open_floor, shaded_floor = lit([FLOOR]), lit([FLOOR, board])
    assert shaded_floor[32, 32] < 0.6 * open_floor[32, 32]
    # Twice as far from the lamp as the board: the shadow is twice as large, 0.6 m from the middle.
    assert shaded_floor[32, 2] > 0.9 * open_floor[32, 2]
    assert shaded_floor[32, 32] < shaded_floor[32, 13] < shaded_floor[32, 2]


def test_the_side_away_from_the_lamp_is_dark():
    ceiling_seen_from_above = Panel(
        FLOOR.corner_m * [1, -1, 1], FLOOR.right_m, -FLOOR.down_m, WHITE
    )
    assert lit([ceiling_seen_from_above]).max() < 0.6 * lit([FLOOR]).max()
