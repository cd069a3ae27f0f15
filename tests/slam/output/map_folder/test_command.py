# SPDX-License-Identifier: Apache-2.0
"""`run_slam --save`, `--load` and `--localise-only`."""

import json
import shutil

import numpy as np
import pytest

from slam.__main__ import main
from slam.evaluation.trajectory import read_tum
from slam.output import claimed_folder

FIRST = 30  # frames there; then it comes back
ASKED = ("--recognizer", "gradients", "--map", "none", "-q")


def part_of(recording, folder, chosen):
    """Copy a recording with some lines of its list of images alone."""
    shutil.copytree(recording, folder)
    for name in ("rgb.txt", "depth.txt"):
        lines = (folder / name).read_text().splitlines()
        head = [line for line in lines if line.startswith("#")]
        rows = [line for line in lines if not line.startswith("#")]
        (folder / name).write_text("\n".join([*head, *rows[chosen]]) + "\n")
    return folder


def content(folder):
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def place(recording, tmp_path_factory):
    """Return a folder with two parts of a recording, and the map of the first."""
    folder = tmp_path_factory.mktemp("place")
    first = part_of(recording, folder / "there", slice(0, FIRST))
    part_of(recording, folder / "back", slice(FIRST, None))
    out = ("--out", str(folder / "first"))
    assert main([str(first), *ASKED, *out, "--save", str(folder / "map")]) == 0
    return folder


def run(place, *asked, out):
    return main([str(place / "back"), *ASKED, "--out", str(out), *map(str, asked)])


def test_a_later_run_goes_on_from_the_map_and_saves_it(place, tmp_path, T_first_cam):
    before = content(place / "map")
    asked = ("--load", place / "map", "--save", tmp_path / "more")
    assert run(place, *asked, out=tmp_path / "run") == 0
    assert content(place / "map") == before
    trajectory = read_tum(tmp_path / "run" / "trajectory.txt")
    errors = (trajectory.T_world_cam - T_first_cam[FIRST:])[:, :3, 3]
    assert np.linalg.norm(errors, axis=1).max() < 0.03
    counts = [
        json.loads((folder / "manifest.json").read_text())["keyframes"]
        for folder in (place / "map", tmp_path / "more")
    ]
    assert counts[0] < counts[1]
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["keyframes"] == counts[1] and summary["frames_tracked"] == len(T_first_cam) - 30
    own = read_tum(tmp_path / "run" / "keyframes.txt")
    assert len(own) == counts[1] - counts[0]
    # The command that it tells is the one that makes it again.
    assert f"--load {place / 'map'}" in summary["command"]


def test_a_run_on_a_map_can_be_kept_for_the_viewer(place, tmp_path):
    pytest.importorskip("rerun", reason="needs Rerun: pip install 'loopclose[live]'")
    asked = ("--load", place / "map", "--rrd", tmp_path / "run.rrd")
    assert run(place, *asked, out=tmp_path / "run") == 0
    assert (tmp_path / "run.rrd").stat().st_size > 100_000


def test_localising_only_leaves_the_map_as_it_is(place, tmp_path):
    before = content(place / "map")
    asked = ("--load", place / "map", "--localise-only")
    assert run(place, *asked, out=tmp_path / "run") == 0
    assert content(place / "map") == before
    assert len(read_tum(tmp_path / "run" / "trajectory.txt")) == 30
    assert (tmp_path / "run" / "report.html").exists()
    assert not (tmp_path / "run" / "measurements.npz").exists()


def test_what_makes_no_sense_together_is_refused(place, tmp_path, capsys):
    for asked, told in (
        (["--localise-only"], "--localise-only needs the map to --load"),
        (["--load", "m", "--localise-only", "--save", "n"], "leaves nothing to --save"),
        (["--load", "m", "--odometry", "x"], "without --odometry"),
        (["--load", tmp_path / "nothing"], "there is no map in this folder"),
        (["--load", place / "map", "--recognizer", "bag-of-words"], "by another recognizer"),
    ):
        assert run(place, *asked, out=tmp_path / "run") == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and told in error
        assert not (tmp_path / "run").exists()


def test_a_killed_run_on_a_map_says_how_to_do_it_again(place, tmp_path, monkeypatch, capsys):
    with monkeypatch.context() as patch:
        patch.setattr("slam.output.ending.write_outputs", killed)
        with pytest.raises(SystemExit):
            run(place, "--load", place / "map", out=tmp_path / "run")
    assert (tmp_path / "run" / claimed_folder.UNFINISHED / claimed_folder.JOURNAL).exists()
    capsys.readouterr()
    assert main([str(tmp_path / "run"), "--finish", "--save", str(tmp_path / "map")]) == 2
    assert "--save and --load need the images of a run" in capsys.readouterr().err
    assert main([str(tmp_path / "run"), "--finish"]) == 2
    assert "a killed run on a map cannot be finished; do again: run_slam" in capsys.readouterr().err


def killed(*_):
    raise SystemExit(9)
