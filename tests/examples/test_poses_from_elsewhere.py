# SPDX-License-Identifier: Apache-2.0

import pytest

from slam import Camera, Config, SlamError, open_sequence
from slam.evaluation.drift import trajectory_error
from slam.evaluation.trajectory import write_tum

SMALL_CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)


@pytest.mark.parametrize("seed", [0, 1])
def test_drift_of_an_odometry_that_is_not_ours_goes_away(example, recording, seed):
    sequence = open_sequence(recording, Config().input)
    odometry = example.drifting(sequence.ground_truth, seed)
    result = example.close_loops(sequence, odometry)
    before, after = (
        trajectory_error(each, sequence.ground_truth, Config().evaluation).ate_rmse_m
        for each in (odometry, result.given.corrected)
    )
    assert after < 0.5 * before


def test_command_reads_an_odometry_file(example, recording, tmp_path, capsys):
    truth = open_sequence(recording, Config().input).ground_truth
    write_tum(tmp_path / "odometry.txt", example.drifting(truth, seed=0))
    example.main(str(recording), str(tmp_path / "odometry.txt"))
    from_file = capsys.readouterr().out
    example.main(str(recording))
    assert from_file == capsys.readouterr().out
    assert "loops closed" in from_file
    assert "ATE" in from_file


def test_nothing_can_be_done_without_poses(example, recording, tmp_path):
    for each in recording.iterdir():
        if each.name != "groundtruth.txt":
            (tmp_path / each.name).symlink_to(each)
    with pytest.raises(SlamError, match="give an odometry file"):
        example.main(str(tmp_path))
