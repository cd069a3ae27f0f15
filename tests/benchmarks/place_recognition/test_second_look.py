# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.place_recognition import second_look
from slam.types import Camera, Features

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)


def _features(points_m, descriptors):
    pixels = points_m[:, :2] / points_m[:, 2:] * 525.0 + (319.5, 239.5)
    count = len(points_m)
    return Features(
        pixels=pixels,
        undistorted_px=pixels,
        octaves=np.zeros(count, np.int64),
        descriptors=descriptors,
        depth_m=points_m[:, 2],
        points_m=points_m,
    )


@pytest.fixture
def seen():
    rng = np.random.default_rng(0)
    points_m = rng.uniform((-1.0, -1.0, 1.0), (1.0, 1.0, 3.0), (60, 3))
    return points_m, rng.integers(0, 256, (60, 32), np.uint8)


def test_the_further_the_camera_moved_the_less_alike(seen):
    points_m, descriptors = seen
    found = []
    for far in (0.0, 0.3, 0.6, 1.2):
        R = Rotation.from_rotvec([0.0, far / 2, 0.0])
        moved = _features(R.apply(points_m) + np.array([far / 2, 0.0, 0.0]), descriptors)
        found.append(second_look._nearness(_features(points_m, descriptors), moved, CAMERA))
    np.testing.assert_allclose(found, [1.0, 0.75, 0.5, 0.0], atol=1e-6)


def test_a_fourth_of_wrong_matches_does_not_matter_and_chance_is_nothing(seen):
    points_m, descriptors = seen
    rng = np.random.default_rng(1)
    some = points_m + np.array([0.2, 0.0, 0.0])
    some[:15] = rng.uniform((-1.0, -1.0, 1.0), (1.0, 1.0, 3.0), (15, 3))
    first = _features(points_m, descriptors)
    near = second_look._nearness(first, _features(some, descriptors), CAMERA)
    assert near == pytest.approx(1.0 - 0.2 / second_look.SPAN, abs=0.02)
    mixed = _features(rng.permutation(points_m), descriptors)
    assert second_look._nearness(first, mixed, CAMERA) == 0.0
    nothing = _features(np.empty((0, 3)), np.empty((0, 32), np.uint8))
    assert second_look._nearness(first, nothing, CAMERA) == 0.0


def test_the_table_of_a_recording(recording, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["x", str(recording), "--recognizer", "gradients"])
    assert second_look.main() == 0
    rows = capsys.readouterr().out.splitlines()
    assert [row.split(" | ")[0] for row in rows[2:]] == ["| embedding", "| features", "| motion"]
