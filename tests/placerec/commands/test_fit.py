# SPDX-License-Identifier: Apache-2.0
import json

import numpy as np
import pytest

from placerec.cli import main


@pytest.fixture(autouse=True)
def draft(tmp_path, monkeypatch):
    """Work in a folder with a recognizer that learns how many images there were, of which mean."""
    (tmp_path / "fitted_draft.py").write_text(
        "import json\n"
        "class Draft:\n"
        "    min_similarity, trained_on = 0.5, ()\n"
        "    def embed(self, image): ...\n"
        "    def fit(self, images, seed):\n"
        "        self.learned = [seed, [float(image.mean()) for image in images]]\n"
        "    def save(self, path):\n"
        "        path.write_text(json.dumps([self.learned, self.trained_on]))\n"
    )
    monkeypatch.chdir(tmp_path)


def test_images_of_all_folders_are_handed_over_and_the_result_is_written(
    tmp_path, write_image, capsys
):
    for i in range(2):
        write_image(tmp_path / f"walk/{i}.png", seed=i)
        write_image(tmp_path / f"drives/query/{i}.png", seed=i)
        write_image(tmp_path / f"drives/ref/{i}.png", seed=i)
    (tmp_path / "walk/2.png").write_bytes(b"oh")
    asked = ["fit", "fitted_draft:Draft", "walk", "drives", "--seed", "7"]
    assert main([*asked, "--out", "it.safetensors"]) == 0
    pictures = [np.random.default_rng(i).integers(0, 256, (12, 16, 3), np.uint8) for i in range(2)]
    means = [float(picture.mean()) for picture in pictures]
    learned = json.loads((tmp_path / "it.safetensors").read_text())
    assert learned == [[7, means * 3], ["walk", "drives"]]
    shown = capsys.readouterr()
    assert "learned from 6 images" in shown.out
    assert "skipped: not a readable image: walk/2.png" in shown.err


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["fitted_draft:Draft"], "at least one folder"),
        (["fitted_draft:Draft", ".", "--out", "it.npz"], ".safetensors"),
        (["placerec.gradients:GradientRecognizer", "."], "nothing to learn"),
        (["fitted_draft:Draft", "nowhere"], "there is no such folder"),
    ],
)
def test_what_cannot_be_done_is_one_line(arguments, what, capsys):
    assert main(["fit", *arguments]) == 2
    error = capsys.readouterr().err
    assert what in error and error.count("\n") == 1
