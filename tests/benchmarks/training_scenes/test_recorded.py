# SPDX-License-Identifier: Apache-2.0
from itertools import islice, pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from benchmarks.training_scenes import recorded
from benchmarks.training_scenes.recorded import APART, RADIUS, RecordedPlace
from slam.config import InputConfig
from slam.datasets import open_sequence
from slam.demo.recording import render_sequence
from slam.geometry.se3 import pose_distance
from slam.types import Camera, Frame

pytestmark = pytest.mark.usefixtures("built_rooms")

FOCAL_PX = 320.0 * recorded.FOCAL_PX / recorded.WIDTH_PX
CAMERA = Camera(320, 240, FOCAL_PX, FOCAL_PX, 159.5, 119.5)
RED = np.zeros((30, 40, 3), np.uint8) + np.array([255, 0, 0], np.uint8)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "room"
    render_sequence(path, seconds=1.0, camera=CAMERA)
    return path


@pytest.fixture(scope="module")
def place(folder: Path) -> RecordedPlace:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorded, "VOXEL_M", 0.02)
        patch.setattr(recorded, "TRUNCATION_M", 0.08)
        patch.setattr(recorded, "FARTHEST_M", 9.0)
        return RecordedPlace(folder)


def first_frame(folder: Path) -> tuple[Frame, np.ndarray]:
    sequence = open_sequence(folder, InputConfig())
    assert sequence.ground_truth is not None
    return sequence.frame(0), sequence.ground_truth.T_world_cam[0]


def seen_later(folder: Path, size: tuple[int, int]) -> np.ndarray:
    """Return the image of a quarter of a second later."""
    rgb = open_sequence(folder, InputConfig()).frame(4).rgb
    return cv2.resize(rgb, size, interpolation=cv2.INTER_AREA).astype(float)


def test_from_where_the_camera_was_the_place_looks_as_recorded(place, folder):
    frame, T_world_cam = first_frame(folder)
    image, share = place.look(T_world_cam, RED)
    size = (recorded.WIDTH_PX, recorded.HEIGHT_PX)
    taken = cv2.resize(frame.rgb, size, interpolation=cv2.INTER_AREA).astype(float)
    assert share > 0.8
    is_mesh = (image != RED[0, 0]).any(axis=2)
    off = np.abs(image - taken)[is_mesh].mean()
    others = {"mirrored": taken[:, ::-1], "red for blue": taken[..., ::-1]}
    others["late"] = seen_later(folder, size)
    for name, other in others.items():
        assert off < 0.7 * np.abs(image - other)[is_mesh].mean(), name


def test_what_was_never_seen_shows_the_photograph(place, folder):
    _, T_world_cam = first_frame(folder)
    behind = T_world_cam.copy()
    behind[:3, :3] = T_world_cam[:3, :3] @ np.diag([-1.0, 1.0, -1.0])
    image, share = place.look(behind, RED)
    assert share < 0.5
    assert (image == RED[0, 0]).all(axis=2).mean() == pytest.approx(1.0 - share, abs=0.01)


def test_the_camera_aims_at_what_lies_before_the_mean_camera(place, folder):
    truth = open_sequence(folder, InputConfig()).ground_truth
    assert truth is not None
    mean = place.aim(np.zeros(7))
    middle_m = mean[:3, 3] + recorded.AHEAD_M * mean[:3, 2]
    np.testing.assert_allclose(mean[:3, 3], truth.T_world_cam[:, :3, 3].mean(axis=0), atol=0.05)
    nearer = place.aim(np.array([0.0, 0.0, 0.0, -0.4, 0.1, 0.3, -0.2]))
    np.testing.assert_allclose(nearer[:3, 3] + 0.6 * nearer[:3, 2], middle_m, atol=1e-9)


def test_a_photograph_goes_on_without_a_seam():
    column = np.arange(40, dtype=np.uint8)[None, :, None]
    photograph = np.broadcast_to(column, (30, 40, 3))
    azimuth = np.linspace(-np.pi, np.pi, 2000)
    around = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(2000)], axis=1)
    shown = recorded._wallpaper(photograph, around)[:, 0]
    assert np.abs(np.diff(shown)).max() <= 1.0
    assert abs(shown[0] - shown[-1]) <= 1.0
    assert shown.min() == 0.0 and shown.max() >= 38.0


def test_images_too_far_in_time_from_a_true_pose_are_not_fused(folder, monkeypatch):
    monkeypatch.setattr(recorded, "LONGEST_WAIT_S", -1.0)
    recording = recorded.read_recording(folder, 1)
    mesh = recorded._fuse(folder, recording, recorded._poses(recording))
    assert len(mesh.vertices) == 0


def test_views_of_a_place_are_near_it_and_places_apart(place, monkeypatch):
    monkeypatch.setattr(recorded, "LEAST_SEEN", 0.3)
    monkeypatch.setattr(recorded, "VIEWS", 3)
    monkeypatch.setattr(recorded, "PLACES", 4)
    views = list(place.views_of_places([RED], seed=0))
    again = list(place.views_of_places([RED], seed=0))
    assert all(np.array_equal(a[1], b[1]) for a, b in zip(views, again, strict=True))
    places = [views[0][2]]
    for _, _, T, _ in views:
        if pose_distance(T, places[-1]) >= APART - RADIUS:
            places.append(T)
        assert pose_distance(T, places[-1]) < RADIUS
    assert len(places) > 1
    assert all(pose_distance(a, b) >= APART for i, a in enumerate(places) for b in places[:i])


def test_a_path_goes_on_in_small_steps(place, monkeypatch):
    monkeypatch.setattr(recorded, "LEAST_SEEN", 0.0)
    steps = list(islice(place.path([RED], seed=0), 20))
    assert np.all(np.diff([time_s for time_s, *_ in steps]) > 0)
    poses = [T for _, _, T, _ in steps]
    assert max(pose_distance(a, b) for a, b in pairwise(poses)) < 0.3
