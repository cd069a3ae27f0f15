# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from benchmarks.training_scenes import __main__ as training_scenes
from benchmarks.training_scenes import rendered
from benchmarks.training_scenes.handheld import path_times_s, write_folder
from benchmarks.training_scenes.rendered import papered
from placerec.datasets import open_dataset
from slam.config import InputConfig
from slam.datasets.formats import open_sequence
from slam.demo.panels import Panel
from slam.demo.room import render


@pytest.mark.parametrize("kind", ["room", "desk"])
def test_a_scene_is_a_recording_with_places(kind, tmp_path, monkeypatch):
    monkeypatch.setattr(rendered, "PLACES", 3)
    write_folder(tmp_path / "scene", rendered.views(kind, 7, [], paths=False))
    scene = open_dataset(str(tmp_path / "scene"))
    assert scene.places is not None
    assert scene[0].shape == (rendered.HEIGHT_PX, rendered.WIDTH_PX, 3)
    assert set(scene.places) == {0, 1, 2}  # those that were meant
    assert scene.comparable[~np.eye(len(scene), dtype=bool)].all()  # each view counts


@pytest.mark.parametrize("kind", ["room", "desk"])
def test_a_path_can_be_recorded_with_depth(kind, tmp_path, monkeypatch):
    whole = rendered.path
    monkeypatch.setattr(rendered, "path_times_s", lambda: path_times_s()[:2])
    monkeypatch.setattr(rendered, "PATH_VIEWS", 2)
    rendered.record_path(tmp_path / "path", kind, 7, [])
    scene, rng = rendered.build_scene(kind, 7, []), np.random.default_rng([7, 0x71E])
    sequence = open_sequence(tmp_path / "path", InputConfig())
    assert len(sequence) == 2
    for frame, T_world_cam in zip(sequence, whole(scene, rng), strict=True):
        seen = render(scene.room, sequence.camera, T_world_cam)
        both = (frame.depth_m > 0.0) & (seen.depth_m > 0.0)
        assert np.median(np.abs(frame.depth_m - seen.depth_m)[both]) < 0.02


@pytest.mark.parametrize("typed", [["--depth"], ["--depth", "--paths", "--recording", "x"]])
def test_depth_is_for_rendered_paths(typed, tmp_path, monkeypatch, capsys):
    out = str(tmp_path / "out")
    monkeypatch.setattr("sys.argv", ["x", out, "--photographs", "ie_tower", *typed])
    with pytest.raises(SystemExit):
        training_scenes.main()
    assert "--depth is for rendered --paths" in capsys.readouterr().err


def test_a_folder_that_could_not_be_finished_is_not_there(tmp_path):
    def broken():
        yield 1.0, np.zeros((4, 4, 3), np.uint8), np.eye(4), 0
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_folder(tmp_path / "scene", broken())
    assert not (tmp_path / "scene").exists()
    write_folder(tmp_path / "scene", [(1.0, np.zeros((4, 4, 3), np.uint8), np.eye(4), None)])
    assert (tmp_path / "scene" / "rgb.txt").read_text() == "1.000000 rgb/1.000000.png\n"


RED = np.full((30, 40, 3), (250, 0, 0), np.uint8)


def _panels(count, size=(32, 48)):
    texture = np.zeros((*size, 3), np.uint8)
    edges = np.eye(3)
    return [Panel(edges[0], edges[1], edges[2], texture) for _ in range(count)]


def _is_papered(panels, share, seed=0, photographs=(RED,)):
    shown = papered(panels, photographs, share, np.random.default_rng(seed))
    return [bool(panel.texture.any()) for panel in shown]


def test_a_share_of_the_panels_shows_a_photograph_in_the_old_size():
    panels = _panels(200)
    assert 60 < sum(_is_papered(panels, 0.4)) < 100
    assert _is_papered(panels, 0.4) == _is_papered(panels, 0.4)
    assert _is_papered(panels, 0.4) != _is_papered(panels, 0.4, seed=1)
    shown = papered(panels, [RED], 1.0, np.random.default_rng(0))
    assert {panel.texture.shape for panel in shown} == {(32, 48, 3)}
    assert all((panel.texture == (250, 0, 0)).all() for panel in shown)


def test_nothing_is_done_where_nothing_is_asked_and_tiny_panels_are_left():
    assert not any(_is_papered(_panels(50), 0.0))
    assert not any(_is_papered(_panels(50, size=(10, 200)), 1.0))


def test_pieces_differ_and_keep_their_proportions():
    ramp = np.tile(np.arange(0, 200, 2, dtype=np.uint8)[:, None, None], (1, 100, 3))
    shown = papered(_panels(20), [ramp], 1.0, np.random.default_rng(0))
    tops = {int(panel.texture[0, 0, 0]) for panel in shown}
    assert len(tops) > 5
    for panel in shown:  # no panel shows more of the height than of the width
        span = int(panel.texture[-1, 0, 0]) - int(panel.texture[0, 0, 0])
        assert 0 < span < 2 * 100 * 32 / 48 + 4
