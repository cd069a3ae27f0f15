# SPDX-License-Identifier: Apache-2.0
import json

import cv2
import numpy as np
import pytest

from placerec.datasets.depth_overlap import DepthCamera, camera_of_run, overlaps
from placerec.datasets.place_dataset import PlaceDataset
from placerec.errors import LoopcloseError

CAMERA = DepthCamera(fx=200.0, fy=200.0, cx=159.5, cy=119.5, depth_scale=1000.0)
WIDTH_M = 320 / 200 * 2.0  # of what is seen of a wall two metres away


def _recording(folder, positions_m, quaternions=None, depths=None):
    """Write depth images of a wall at z = 2 m, and return the dataset of their poses."""
    count = len(positions_m)
    (folder / "depth").mkdir(parents=True)
    depths = depths or [np.full((240, 320), 2000, np.uint16)] * count
    for k, depth in enumerate(depths):
        if depth is not None:
            cv2.imwrite(str(folder / "depth" / f"{k}.png"), depth)
    lines = [f"{k}.0 depth/{k}.png\n" for k, depth in enumerate(depths) if depth is not None]
    (folder / "depth.txt").write_text("".join(lines))
    everyone, every_pair = np.arange(count), np.ones((count, count), np.bool_)
    return PlaceDataset(
        name="wall",
        paths=tuple(folder / f"{k}.png" for k in range(count)),
        queries=everyone,
        references=everyone,
        same_place=every_pair,
        comparable=every_pair,
        timestamps_s=everyone.astype(np.float64),
        positions_m=np.array(positions_m, np.float64),
        quaternions=np.array(quaternions or [(0, 0, 0, 1)] * count, np.float64),
    )


def _shares(folder, dataset, pairs=None):
    count = len(dataset)
    return overlaps(
        folder, dataset, CAMERA, np.ones((count, count), np.bool_) if pairs is None else pairs
    )


def test_the_share_is_what_is_left_of_a_view_that_is_moved_or_turned_away(tmp_path):
    turned = (0.0, np.sin(np.pi / 2), 0.0, np.cos(np.pi / 2))
    positions_m = [(0, 0, 0), (WIDTH_M / 2, 0, 0), (WIDTH_M * 1.1, 0, 0), (0, 0, 0)]
    poses = [(0, 0, 0, 1)] * 3 + [turned]
    shares = _shares(tmp_path, _recording(tmp_path, positions_m, poses))
    assert shares[0, 0] == 1.0
    assert shares[0, 1] == pytest.approx(0.5, abs=0.06)
    assert shares[1, 0] == shares[0, 1]
    assert shares[0, 2] == 0.0 and shares[0, 3] == 0.0


def test_what_is_hidden_is_not_seen(tmp_path):
    behind_a_board = np.full((240, 320), 2000, np.uint16)
    behind_a_board[:, :160] = 800
    dataset = _recording(
        tmp_path, [(0, 0, 0)] * 2, depths=[np.full((240, 320), 2000, np.uint16), behind_a_board]
    )
    assert _shares(tmp_path, dataset)[0, 1] == pytest.approx(0.5, abs=0.03)


def test_where_depth_is_silent_nothing_is_claimed(tmp_path):
    nothing = np.zeros((240, 320), np.uint16)
    wall = np.full((240, 320), 2000, np.uint16)
    half = wall.copy()
    half[:120] = 0
    dataset = _recording(tmp_path, [(0, 0, 0)] * 4, depths=[wall, nothing, None, half])
    shares = _shares(tmp_path, dataset)
    assert np.isnan(shares[0, 1:3]).all() and np.isnan(shares[2]).all()
    assert shares[0, 3] == 1.0


def test_only_what_was_asked_for_is_looked_at(tmp_path):
    pairs = np.zeros((3, 3), np.bool_)
    pairs[0, 1] = pairs[1, 0] = True
    shares = _shares(tmp_path, _recording(tmp_path, [(0, 0, 0)] * 3), pairs)
    assert np.isfinite(shares).tolist() == pairs.tolist()


def test_depth_that_is_none_is_named(tmp_path):
    dataset = _recording(tmp_path, [(0, 0, 0)] * 2)
    (tmp_path / "depth" / "1.png").write_bytes(b"no image")
    with pytest.raises(LoopcloseError, match=r"^not a depth image: .*1\.png$"):
        _shares(tmp_path, dataset)
    cv2.imwrite(str(tmp_path / "depth" / "1.png"), np.zeros((240, 320, 3), np.uint8))
    with pytest.raises(LoopcloseError, match=r"it has colours: .*1\.png$"):
        _shares(tmp_path, dataset)


def test_the_camera_is_that_of_the_run(tmp_path):
    summary = tmp_path / "summary.json"
    camera = {**CAMERA.model_dump(), "width": 320, "height": 240}
    summary.write_text(json.dumps({"camera": camera}))
    assert camera_of_run(summary) == CAMERA
    for wrong in ({}, [], {"camera": None}, {"camera": {**camera, "fx": 0.0}}):
        summary.write_text(json.dumps(wrong))
        with pytest.raises(LoopcloseError, match="no camera is named in it"):
            camera_of_run(summary)
