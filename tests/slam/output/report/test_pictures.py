# SPDX-License-Identifier: Apache-2.0
import base64
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

from slam.output.decision import decisions
from slam.output.report import pictures as module
from slam.output.report.pictures import map_points, pictures


def unpacked(packed: str, kind: str) -> np.ndarray:
    return np.frombuffer(base64.b64decode(packed), kind).reshape(-1, 3)


def test_every_keyframe_of_a_loop_has_a_picture(run) -> None:
    loops = decisions(run.result, None)
    found = pictures(run.result, loops)
    assert set(found) == {each.id for loop in loops for each in (loop.match, loop.query)}
    kind, content = found[loops[0].query.id].split(",")
    assert kind == "data:image/jpeg;base64"
    image = np.asarray(Image.open(BytesIO(base64.b64decode(content))), float)
    assert image.shape == (240, 320, 3)
    assert np.abs(image - loops[0].query.preview.rgb).mean() < 8


def test_where_there_is_no_room_the_first_loops_have_pictures(run, monkeypatch) -> None:
    loops = decisions(run.result, None)
    whole = pictures(run.result, loops)
    monkeypatch.setattr(module, "_PICTURES_BYTES", 30_000)
    found = pictures(run.result, loops)
    assert 2 <= len(found) < len(whole)
    assert {loops[0].match.id, loops[0].query.id} <= set(found)
    assert sum(map(len, found.values())) <= 30_000
    assert Image.open(BytesIO(base64.b64decode(found[loops[0].match.id][23:]))).width == 160


def test_a_run_without_images_has_neither_pictures_nor_a_map(run) -> None:
    bare = [
        replace(each.preview, depth_m=0 * each.preview.depth_m) for each in run.result.keyframes
    ]
    keyframes = tuple(
        replace(each, preview=preview)
        for each, preview in zip(run.result.keyframes, bare, strict=True)
    )
    result = replace(run.result, keyframes=keyframes)
    assert pictures(result, decisions(result, None)) == {}
    assert map_points(result) is None


def test_points_are_where_their_pixels_were_seen(run) -> None:
    camera, keyframe = run.result.camera, run.result.keyframes[3]
    found = map_points(run.result)
    assert found["keyframes"] == list(range(40))
    assert sum(found["counts"]) <= 1.2 * 18_000
    points_m = unpacked(found["points"], "<i2") * found["unit_m"]
    first = sum(found["counts"][:3])
    of_keyframe = points_m[first : first + found["counts"][3]]
    assert_allclose(of_keyframe[:, 2], 1.0, atol=1e-4)  # as far as everything is in this run
    u = camera.fx * of_keyframe[:, 0] + camera.cx
    v = camera.fy * of_keyframe[:, 1] + camera.cy
    u, v = np.rint(u / 2).astype(int), np.rint(v / 2).astype(int)
    colours = unpacked(found["colours"], "u1")[first : first + found["counts"][3]]
    assert (colours == keyframe.preview.rgb[v, u]).all()


def test_points_of_another_camera_are_where_that_saw_them(run) -> None:
    before = map_points(run.result)
    camera = replace(run.result.camera, width=320, height=240, cx=159.5, cy=119.5)
    smaller = run.result.keyframes[3]
    shown = replace(
        smaller.preview,
        rgb=smaller.preview.rgb[60:180, 80:240],
        depth_m=smaller.preview.depth_m[60:180, 80:240],
    )
    keyframes = list(run.result.keyframes)
    keyframes[3] = replace(smaller, preview=shown, camera=camera)
    found = map_points(replace(run.result, keyframes=tuple(keyframes)))
    assert found["counts"][3] < before["counts"][3] / 3
    points_m = unpacked(found["points"], "<i2") * found["unit_m"]
    first = sum(found["counts"][:3])
    own_m = points_m[first : first + found["counts"][3]]
    assert np.abs(own_m[:, 0]).max() < 160.0 / camera.fx + 0.01


@pytest.mark.parametrize("placed", [0, 1])
def test_keyframes_without_a_place_show_nothing_in_the_map(run, placed: int) -> None:
    T_world_kf = run.result.T_world_kf.copy()
    T_world_kf[placed:] = np.nan
    found = map_points(replace(run.result, T_world_kf=T_world_kf))
    assert (found is None) if placed == 0 else (found["keyframes"] == [0])
