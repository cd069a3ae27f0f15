# SPDX-License-Identifier: Apache-2.0
import importlib.util
from pathlib import Path

import pytest

from slam import Camera, Config, SlamError, open_sequence
from slam.demo.recording import render_sequence
from slam.evaluation.drift import trajectory_error
from slam.evaluation.trajectory import write_tum

EXAMPLE = Path(__file__).parents[2] / "examples" / "poses_from_elsewhere.py"
SMALL_CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location(EXAMPLE.stem, EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Render a third of the room, there by every other image and back by the rest, in 8 s."""
    folder = tmp_path_factory.mktemp("rendered") / "there_and_back"
    render_sequence(folder, seconds=4.0, camera=SMALL_CAMERA)
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        _, *lines = (folder / name).read_text().splitlines()
        tour = [*lines[::2], *lines[::-2]]
        stamped = [f"{i / 7.5:.6f} {line.split(' ', 1)[1]}\n" for i, line in enumerate(tour)]
        (folder / name).write_text("".join(stamped))
    return folder


@pytest.mark.parametrize("seed", [0, 1])
def test_drift_of_an_odometry_that_is_not_ours_goes_away(example, folder, seed):
    sequence = open_sequence(folder, Config().input)
    odometry = example.drifting(sequence.ground_truth, seed)
    result = example.close_loops(sequence, odometry)
    before, after = (
        trajectory_error(each, sequence.ground_truth, Config().evaluation).ate_rmse_m
        for each in (odometry, result.given.corrected)
    )
    assert after < 0.5 * before


def test_command_reads_an_odometry_file(example, folder, tmp_path, capsys):
    truth = open_sequence(folder, Config().input).ground_truth
    write_tum(tmp_path / "odometry.txt", example.drifting(truth, seed=0))
    example.main(str(folder), str(tmp_path / "odometry.txt"))
    from_file = capsys.readouterr().out
    example.main(str(folder))
    assert from_file == capsys.readouterr().out
    assert "loops closed" in from_file
    assert "ATE" in from_file


def test_nothing_can_be_done_without_poses(example, folder, tmp_path):
    for each in folder.iterdir():
        if each.name != "groundtruth.txt":
            (tmp_path / each.name).symlink_to(each)
    with pytest.raises(SlamError, match="give an odometry file"):
        example.main(str(tmp_path))
