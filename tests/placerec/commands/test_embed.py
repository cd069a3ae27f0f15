# SPDX-License-Identifier: Apache-2.0
import csv
import re
import shlex
import sys
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

from placerec.__main__ import _parse, main
from placerec.commands import embed as command
from placerec.commands.fleet import Finished

PAGE = Path(__file__).parents[3] / "docs" / "batch.md"
COMMANDS = re.findall(r"^    (placerec .+)$", PAGE.read_text(), re.MULTILINE)
GRADIENTS = ("--recognizer", "gradients")
FATAL = """
import os, signal
from pathlib import Path
from placerec.recognizers.gradients import GradientRecognizer


class Fatal(GradientRecognizer):
    def embed(self, image):
        mark = Path(__file__).with_name("killed")
        if image[0, 0, 0] == 255 and not mark.exists():
            mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().embed(image)
"""


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.chdir(tmp_path)


@pytest.fixture
def folders(tmp_path, write_image):
    """Write the folders a and b, of three images each; the last one of b is broken."""
    for name in "ab":
        for i in range(3):
            write_image(tmp_path / name / f"{i}.png", seed=ord(name) + i)
    (tmp_path / "b" / "2.png").write_bytes(b"oh")
    return ["a", "b"]


def content(folder):
    return {each.name: each.read_bytes() for each in Path(folder).iterdir()}


@pytest.mark.parametrize("typed", COMMANDS)
def test_what_the_page_tells_to_type_can_be_typed(typed):
    assert _parse(shlex.split(typed)[1:])


def test_each_folder_leaves_its_embeddings_and_all_are_in_one_table(folders, tmp_path, capsys):
    assert main(["embed", *folders, *GRADIENTS, "--out", "out"]) == 0
    told = capsys.readouterr()
    assert "| b    |      2 |       1 |    496 |" in told.out
    assert f"skipped: not a readable image: {tmp_path}/b/2.png" in told.err
    with np.load("out/a.npz") as made:
        assert made["embeddings"].shape == (3, 496)
        assert [Path(each).name for each in made["images"]] == ["0.png", "1.png", "2.png"]
    rows = csv.DictReader(Path("out/embeddings.csv").read_text().splitlines())
    assert [row["images"] for row in rows] == ["3", "2"]


def test_of_a_recording_all_that_its_list_names_is_embedded_with_its_times(write_image, tmp_path):
    for i in range(2):
        write_image(tmp_path / "walk" / "rgb" / f"{i}.png", seed=i)
    (tmp_path / "walk" / "rgb.txt").write_text("1.5 rgb/0.png\n1.75 rgb/1.png\n")
    assert main(["embed", "walk", *GRADIENTS, "--out", "out"]) == 0
    with np.load("out/walk.npz") as made:
        assert made["timestamps_s"].tolist() == [1.5, 1.75] and len(made["embeddings"]) == 2


def test_what_is_done_is_not_done_again_and_what_fails_stops_no_other(folders, monkeypatch, capsys):
    asked = ["embed", "a", "missing", *GRADIENTS, "--out", "out", "--no-cache"]
    assert main(asked) == 2
    told = capsys.readouterr()
    assert "error: missing: there is no such folder" in told.err
    assert "1 of 2 data sets failed, which the same command tries again: missing" in told.err
    assert "| a       |      3 |" in told.out and "| missing | failed: there is no" in told.out
    before = content("out")["a.npz"]

    Path("b").rename("missing")
    monkeypatch.setattr(command, "embed_alone", _only("missing", command.embed_alone))
    assert main(asked) == 0
    assert "1 of 2 data sets are embedded already" in capsys.readouterr().err
    assert content("out")["a.npz"] == before and len(content("out")) == 3


def _only(name, embed_alone):
    def embed(task, progress=None):
        assert Path(task.source).name == name
        return embed_alone(task, progress)

    return embed


def test_what_was_made_otherwise_is_refused_before_anything_starts(folders, capsys):
    assert main(["embed", "a", *GRADIENTS, "--out", "out"]) == 0
    before = content("out")
    Path("a").rename("c")
    Path("c/a").mkdir()
    for typed, told in (
        (["c/a", *GRADIENTS], "a.npz is there, and of the data "),
        (["b", "x/b", *GRADIENTS], "two are called b"),
        (["b", *GRADIENTS, "--cores", "0"], "have to be above 0"),
        (["b", "--recognizer", "nobody"], "nobody"),
        (GRADIENTS, "embed needs at least one folder"),
    ):
        assert main(["embed", *typed, "--out", "out"]) == 2
        assert told in capsys.readouterr().err.splitlines()[-1]
    Path("c").rename("a")
    assert main(["embed", "a", "--recognizer", "learned", "--out", "out"]) == 2
    assert "a.npz is there, and of another recognizer; choose" in capsys.readouterr().err
    Path("out/b.npz").write_bytes(b"mine")
    assert main(["embed", "b", *GRADIENTS, "--out", "out"]) == 2
    assert "not a file of embeddings, or damaged" in capsys.readouterr().err
    assert content("out") == {**before, "b.npz": b"mine"}


@pytest.mark.skipif(find_spec("ray") is None, reason="needs Ray: pip install 'loopclose[fleet]'")
def test_a_worker_that_is_killed_on_the_way_is_replaced_and_nothing_tells(tmp_path, write_image):
    (tmp_path / "fatal.py").write_text(FATAL)
    for name in "ab":
        for i in range(3):
            write_image(tmp_path / name / f"{i}.png", seed=ord(name) + i)
    cv2.imwrite("b/1.png", np.full((12, 16, 3), 255, np.uint8))
    asked = ["embed", "a", "b", "--recognizer", "fatal:Fatal", "--memory-mb", "100"]
    assert main([*asked, "--out", "many", "--address", "local"]) == 0
    assert (tmp_path / "killed").exists()
    assert main([*asked, "--out", "alone"]) == 0
    assert content("many") == content("alone") and len(content("many")) == 3


def test_what_died_and_what_is_nowhere_to_be_seen_failed(folders, monkeypatch, capsys):
    def run_all(work, tasks, fleet, tell):
        assert (fleet.address, fleet.cores, fleet.memory_mb) == ("ray://head:10001", 2, 512)
        tell(Finished(1, None, "the worker died"))
        tell(Finished(0, ""))

    monkeypatch.setattr("placerec.commands.fleet.run_all", run_all)
    asked = ("--address", "ray://head:10001", "--cores", "2", "--memory-mb", "512")
    assert main(["embed", *folders, *GRADIENTS, *asked]) == 2
    told = capsys.readouterr().out
    assert "| a    | failed: its file does not show here" in told
    assert "| b    | failed: the worker died |" in told


def test_stopping_says_how_it_goes_on(folders, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(command, "embed_dataset", interrupted)
    assert main(["embed", *folders, *GRADIENTS]) == 2
    assert "stopped; the same command goes on" in capsys.readouterr().err
