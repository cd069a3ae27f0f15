# SPDX-License-Identifier: Apache-2.0
import os
from pathlib import Path

import cv2
import numpy as np
import pytest

from placerec.conformance import check
from placerec.recognizers.gradients import GradientRecognizer

ROOT = Path(__file__).parents[3]
DATA = Path(os.environ.get("LOOPCLOSE_DATA", ROOT / "../shared/data"))


def test_conforms():
    report = check(GradientRecognizer())
    assert report.passed, str(report)


def test_image_without_any_texture_has_an_embedding():
    for value in (0, 255):
        embedding = GradientRecognizer().embed(np.full((48, 64, 3), value, np.uint8))
        assert np.linalg.norm(embedding) == pytest.approx(1.0, abs=1e-5)


def test_colour_counts():
    image = np.zeros((120, 160, 3), np.uint8)
    image[30:90, 40:120] = (200, 40, 40)
    recognizer = GradientRecognizer()
    red, blue = recognizer.embed(image), recognizer.embed(np.ascontiguousarray(image[..., ::-1]))
    assert red @ blue < 0.97


def test_threshold_keeps_one_room_and_refuses_most_of_another_building():
    folder = DATA / "rgbd_dataset_freiburg1_xyz" / "rgb"
    paths = sorted(folder.glob("*"))[::20]
    if not paths:
        pytest.skip(f"no TUM fr1_xyz in {DATA}")
    other = sorted((DATA / "ie_tower" / "images").glob("*/*.jpg"))[::100]
    if not other:
        pytest.skip(f"no ie_tower in {DATA}")
    recognizer = GradientRecognizer()
    room = np.array([recognizer.embed(_read(path)) for path in paths])
    tower = np.array([recognizer.embed(_read(path)) for path in other])
    assert (room @ room.T).min() >= recognizer.min_similarity
    assert (room @ tower.T < recognizer.min_similarity).mean() > 0.9


def _read(path: Path) -> np.ndarray:
    return cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB)


def test_other_embeddings_have_another_version():
    # Who changes these numbers changes the version too: certificates and caches go by it.
    image = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)
    recognizer = GradientRecognizer()
    embedding = recognizer.embed(np.kron(image, np.ones((10, 10, 1), np.uint8)))
    assert recognizer.fingerprint == "gradients, version 1"
    expected = [0.116972, 0.006183, -0.004840, 0.002012, -0.001854, 0.003994, 0.000650, 0.002888]
    np.testing.assert_allclose(embedding[::62], expected, atol=1e-5)
    assert embedding.sum() == pytest.approx(6.8643, abs=1e-3)
