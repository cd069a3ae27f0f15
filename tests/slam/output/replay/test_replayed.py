# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.recognizers.gradients import GradientRecognizer
from slam.config import Config
from slam.output.journal import Header, JournalWriter, read_journal
from slam.output.replay.replayed import replayed
from slam.system import Slam
from slam.system.finishing import WITHOUT_IMAGES
from slam.types import SlamError


def journal_of(slam, camera, frames, folder, poses=None, sessions=()):
    header = Header("room", "run_slam room", camera, slam.min_similarity, None, ())
    folder.mkdir()
    with JournalWriter(folder, header, slam) as writer:
        for number, frame in enumerate(frames):
            if number in sessions:
                slam.start_session()
                writer.start_session()
            writer.add(frame, slam.process(frame))
        slam.settle()
    return read_journal(folder)


def finished(journal):
    return replayed(journal, Config(), None).finish()


@pytest.fixture(scope="module")
def both(tmp_path_factory, frames, sequence):
    """Return the result of a run, and the one that its journal gives."""
    slam = Slam(sequence.camera, GradientRecognizer())
    folder = tmp_path_factory.mktemp("run") / "unfinished"
    journal = journal_of(slam, sequence.camera, frames, folder)
    return slam.finish(), finished(journal)


def test_a_run_is_finished_without_its_images(both, T_first_cam):
    result, again = both
    assert len(again.trajectory) == len(result.trajectory) == 60
    assert len(again.keyframes) == len(result.keyframes)
    error_m = np.linalg.norm((again.trajectory.T_world_cam - T_first_cam)[:, :3, 3], axis=1)
    assert error_m.max() < 0.05
    assert WITHOUT_IMAGES in again.warnings and not again.missing and not again.has_images


def test_without_images_there_is_no_map_to_save(tmp_path, frames, sequence):
    slam = Slam(sequence.camera, GradientRecognizer())
    again = replayed(journal_of(slam, sequence.camera, frames[:5], tmp_path / "x"), Config(), None)
    result = again.finish()
    with pytest.raises(SlamError, match="without its images"):
        again.saved(result)


def test_how_long_the_run_took_is_not_known(both):
    assert both[1].elapsed_s is None and not both[1].stage_seconds


def test_its_loops_are_weighed_again(both):
    result, again = both
    pairs = [(each.query_id, each.match_id) for each in result.attempts]
    assert [(each.query_id, each.match_id) for each in again.attempts] == pairs
    weights = [each.weight for each in result.attempts]
    assert [each.weight is None for each in again.attempts] == [each is None for each in weights]
    assert sum(each.rejection is None for each in again.attempts) > 0


def test_lost_frames_and_sessions_are_those_of_the_run(tmp_path, frames, sequence):
    dark = [
        frames[i].__class__(f.timestamp_s, 0 * f.rgb, f.depth_m) if i in (8, 9) else f
        for i, f in enumerate(frames[:30])
    ]
    slam = Slam(sequence.camera, GradientRecognizer())
    journal = journal_of(slam, sequence.camera, dark, tmp_path / "x", sessions=(0, 20))
    result, again = slam.finish(), finished(journal)
    assert np.array_equal(again.untracked_s, result.untracked_s) and len(again.untracked_s) > 1
    assert np.array_equal(again.session_starts_s, result.session_starts_s)
    assert [each.segment for each in again.keyframes] == [each.segment for each in result.keyframes]


def test_the_same_journal_gives_the_same_bits(tmp_path, frames, sequence):
    slam = Slam(sequence.camera, GradientRecognizer())
    journal = journal_of(slam, sequence.camera, frames[:20], tmp_path / "x")
    first, second = finished(journal), finished(journal)
    assert np.array_equal(first.trajectory.T_world_cam, second.trajectory.T_world_cam)
