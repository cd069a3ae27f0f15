# SPDX-License-Identifier: Apache-2.0
import numpy as np

from benchmarks.training_scenes.photographs import paper
from slam.demo.panels import Panel

RED = np.full((30, 40, 3), (250, 0, 0), np.uint8)


def _panels(count, size=(32, 48)):
    texture = np.zeros((*size, 3), np.uint8)
    edges = np.eye(3)
    return [Panel(edges[0], edges[1], edges[2], texture) for _ in range(count)]


def _papered(panels, share, seed=0, photographs=(RED,)):
    papered = paper(panels, photographs, share, np.random.default_rng(seed))
    return [bool(panel.texture.any()) for panel in papered]


def test_a_share_of_the_panels_shows_a_photograph_in_the_old_size():
    panels = _panels(200)
    assert 60 < sum(_papered(panels, 0.4)) < 100
    assert _papered(panels, 0.4) == _papered(panels, 0.4)
    assert _papered(panels, 0.4) != _papered(panels, 0.4, seed=1)
    shown = paper(panels, [RED], 1.0, np.random.default_rng(0))
    assert {panel.texture.shape for panel in shown} == {(32, 48, 3)}
    assert all((panel.texture == (250, 0, 0)).all() for panel in shown)


def test_nothing_is_done_where_nothing_is_asked_and_tiny_panels_are_left():
    assert not any(_papered(_panels(50), 0.0))
    assert not any(_papered(_panels(50, size=(10, 200)), 1.0))


def test_pieces_differ_and_keep_their_proportions():
    ramp = np.tile(np.arange(0, 200, 2, dtype=np.uint8)[:, None, None], (1, 100, 3))
    shown = paper(_panels(20), [ramp], 1.0, np.random.default_rng(0))
    tops = {int(panel.texture[0, 0, 0]) for panel in shown}
    assert len(tops) > 5
    for panel in shown:  # no panel shows more of the height than of the width
        span = int(panel.texture[-1, 0, 0]) - int(panel.texture[0, 0, 0])
        assert 0 < span < 2 * 100 * 32 / 48 + 4
