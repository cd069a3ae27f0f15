# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

import numpy as np
import pytest

from placerec.baselines.fitted import Fitted, read_fitted
from placerec.cli import main


class Brightness:
    """Learns how bright images are."""

    @classmethod
    def fit(cls, images):
        return Fitted({"mean": np.float32([np.mean([image.mean() for image in images])])}, {})


@pytest.fixture(autouse=True)
def installed(tmp_path, monkeypatch):
    """Install recognizers called brightness, with something to fit, and plain, without."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    folder = tmp_path / "site" / "theirs-1.0.dist-info"
    folder.mkdir(parents=True)
    (folder / "METADATA").write_text("Name: theirs\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(
        "[placerec.recognizers]\nbrightness = fit_of_a_test:Brightness\nplain = builtins:object\n"
        "broken = no_such_module:Recognizer\n"
    )
    monkeypatch.setattr(sys, "path", [str(tmp_path / "site"), *sys.path])
    monkeypatch.setitem(sys.modules, "fit_of_a_test", sys.modules[__name__])


@pytest.fixture
def folder(tmp_path, write_image) -> Path:
    for i in range(3):
        write_image(tmp_path / f"photos/{i}.png", seed=i)
    return tmp_path / "photos"


def test_a_method_looks_at_a_folder_and_what_it_learns_is_kept(folder, capsys):
    assert main(["fit", "brightness", str(folder)]) == 0
    found = read_fitted("brightness")
    assert found.data == "photos"
    assert found.arrays["mean"] == pytest.approx([127.5], abs=6)
    assert "brightness was fitted to 3 images of photos" in capsys.readouterr().out


def test_of_a_dataset_it_sees_the_part_for_training(tmp_path, write_image, capsys):
    tower = tmp_path / "tower"
    rows = ["image_path,floor,area,section,split"]
    for floor in ("floor1", "floor6", "floor9"):
        for i in range(4):
            name = f"images/{floor}/{floor}_hall_c1_frame_{i + 1:06}.jpg"
            write_image(tower / name, seed=i)
            rows.append(f"{name},{floor},hall,above-ground,gallery")
    (tower / "dataset.csv").write_text("\n".join(rows) + "\n")
    assert main(["fit", "brightness", str(tower), "--out", str(tmp_path / "out")]) == 0
    assert "to 4 images of tower:train" in capsys.readouterr().out
    assert (tmp_path / "out" / "brightness.safetensors").is_file()


@pytest.mark.parametrize("name", ["plain", "no-such-thing"])
def test_where_there_is_nothing_to_fit_it_says_so(name, folder, capsys):
    assert main(["fit", name, str(folder)]) == 2
    assert f"nothing to fit in a recognizer '{name}'" in capsys.readouterr().err


def test_a_recognizer_that_cannot_be_imported_is_one_line(folder, capsys):
    assert main(["fit", "broken", str(folder)]) == 2
    error = capsys.readouterr().err
    assert "recognizer 'broken' cannot be imported: ModuleNotFoundError" in error
    assert error.count("\n") == 1


def test_a_broken_image_or_no_folder_is_one_line(folder, capsys):
    (folder / "1.png").write_bytes(b"oh")
    assert main(["fit", "brightness", str(folder)]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert main(["fit", "brightness", str(folder / "nowhere")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
