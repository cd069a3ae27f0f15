# SPDX-License-Identifier: Apache-2.0
import sys

import numpy as np
import pytest

from placerec.__main__ import main
from placerec.certificate import read_certificate
from placerec.recognizers.fitted_file import Fitted, read_fitted


class Brightness:
    """Learns how bright images are on the whole, and compares how bright they are above that."""

    min_similarity = 0.5

    def __init__(self, path):
        self.fitted = read_fitted(path, "brightness")
        self.min_similarity = self.fitted.min_similarity

    def embed(self, image):
        angle = (image.mean() - self.fitted.arrays["means"].mean()) / 10.0
        return np.array([np.cos(angle), np.sin(angle)], np.float32)

    @classmethod
    def fit(cls, images, seed):
        in_turn = [image.mean() for image in images]
        again = [images[i].mean() for i in range(len(images))]
        assert in_turn == again
        return Fitted({"means": np.array(in_turn)}, {"seed": str(seed)})


class Careless(Brightness):
    """Learns what it is told to, by its seed."""

    @classmethod
    def fit(cls, images, seed):
        wrong = {1: {}, 2: Fitted({"means": np.array([1.0, np.nan])}), 3: Fitted({}, {"n": 3})}
        if seed not in wrong:
            raise OSError("no disk\nat all")
        return wrong[seed]


class Boundless(Brightness):
    min_similarity = 7.0


@pytest.fixture(autouse=True)
def installed(tmp_path, monkeypatch):
    """Install recognizers: brightness, with something to learn, plain, without, and broken."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)
    folder = tmp_path / "site" / "theirs-1.0.dist-info"
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text("Name: theirs\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(
        "[placerec.recognizers]\nbrightness = fit_of_a_test:Brightness\nplain = builtins:object\n"
        "broken = no_such_module:Broken\ncareless = fit_of_a_test:Careless\n"
        "boundless = fit_of_a_test:Boundless\n"
    )
    monkeypatch.setattr(sys, "path", [str(tmp_path / "site"), *sys.path])
    monkeypatch.setitem(sys.modules, "fit_of_a_test", sys.modules[__name__])


@pytest.fixture
def drives(tmp_path, write_image):
    """Write a folder of two images and one that is broken, and two drives of four images in all."""
    for i in range(2):
        write_image(tmp_path / f"walk/{i}.png", seed=i)
        write_image(tmp_path / f"drives/query/{i}.png", seed=i)
        write_image(tmp_path / f"drives/ref/{i}.png", seed=i)
    (tmp_path / "walk/2.png").write_bytes(b"oh")


def test_it_learns_from_all_folders_and_the_file_names_the_recognizer(drives, tmp_path, capsys):
    command = ["fit", "brightness", "walk", "drives", "--seed", "7", "--out", "it.safetensors"]
    assert main(command) == 0
    fitted = read_fitted(tmp_path / "it.safetensors", "brightness")
    pictures = [np.random.default_rng(i).integers(0, 256, (12, 16, 3), np.uint8) for i in range(2)]
    assert fitted.arrays["means"].tolist() == [float(picture.mean()) for picture in pictures] * 3
    assert (fitted.trained_on, fitted.facts) == (("walk", "drives"), {"seed": "7"})
    assert fitted.min_similarity == 0.5
    shown = capsys.readouterr()
    assert "learned from 6 images of walk, drives" in shown.out
    assert "skipped: not a readable image: walk/2.png" in shown.err
    apart = ["--out", "evaluation", "--no-cache"]
    data = "walk+drives/ref:0"
    assert main(["evaluate", data, "--recognizers", "it.safetensors", *apart]) == 0
    assert "it.safetensors" in capsys.readouterr().out


def test_calibrating_gives_the_file_its_threshold_and_its_evidence(drives, tmp_path):
    path = tmp_path / "brightness.safetensors"
    assert main(["fit", "brightness", "walk"]) == 0
    before = read_fitted(path, "brightness")
    assert main(["calibrate", "walk+drives/ref:0", "--recognizer", str(path)]) == 0
    certificate = read_certificate(tmp_path / "brightness.certificate.json")
    after = read_fitted(path, "brightness")
    assert after.min_similarity == certificate.min_similarity != before.min_similarity
    assert (after.fingerprint, after.trained_on) == (before.fingerprint, before.trained_on)


@pytest.mark.parametrize(
    ("arguments", "what"),
    [
        (["brightness"], "at least one folder"),
        (["brightness", ".", "--out", "it.npz"], ".safetensors"),
        (["plain", "."], "nothing to learn"),
        (["no-such-thing", "."], "there is no recognizer"),
        (["broken", "."], "'broken' cannot be imported: ModuleNotFoundError"),
        (["brightness", "nowhere"], "there is no such folder"),
        (["fit_of_a_test:Brightness", "walk"], "must not name code to run"),
        (["brightness", "walk", "--out", "nowhere/it.safetensors"], "a folder that is there"),
        (["brightness", "walk", "--seed", "-1"], "a seed that is not negative"),
        (["careless", "walk"], "'careless' failed to learn: OSError: no disk at all"),
        (["careless", "walk", "--seed", "1"], "learned a dict; fit returns a Fitted"),
        (["careless", "walk", "--seed", "2"], "values in 'means' that are NaN or infinite"),
        (["careless", "walk", "--seed", "3"], "facts.n = 3 cannot be kept in a file"),
        (["boundless", "walk"], "min_similarity = 7.0 cannot be kept in a file"),
    ],
)
def test_what_cannot_be_done_is_one_line(arguments, what, tmp_path, write_image, capsys):
    write_image(tmp_path / "walk/0.png")
    assert main(["fit", *arguments]) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error.startswith("placerec: ") and what in error
    assert not [*tmp_path.glob("**/*.safetensors")]
