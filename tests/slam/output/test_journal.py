# SPDX-License-Identifier: Apache-2.0
import os
import time
from dataclasses import replace

import numpy as np
import pytest

from placerec.recognizers.gradients import GradientRecognizer
from slam.config import Config
from slam.evaluation.trajectory import read_tum
from slam.output import journal
from slam.output.claimed_folder import JOURNAL
from slam.output.journal import Header, JournalWriter, read_journal
from slam.output.ledger.reading import read_ledger
from slam.output.replay.measurements import (
    MEASUREMENTS,
    Measurements,
    read_measurements,
    write_measurements,
)
from slam.output.replay.replayed import replayed
from slam.system import Slam
from slam.types import Rejection, SlamError


def header_of(sequence):
    threshold = GradientRecognizer.min_similarity
    return Header("room", "run_slam room", sequence.camera, threshold, None, ("doubt",))


@pytest.fixture(scope="module")
def kept(tmp_path_factory, frames, sequence):
    """Return the folder of the journal of a whole run, with what tracking said of each frame."""
    folder = tmp_path_factory.mktemp("unfinished")
    slam = Slam(sequence.camera, GradientRecognizer())
    found = []
    with JournalWriter(folder, header_of(sequence), slam) as writer:
        writer.start_session()
        for frame in frames:
            found.append((frame.timestamp_s, slam.process(frame)))
            writer.add(frame, found[-1][1])
        slam.settle()
    assert writer.failure is None
    return folder, found, slam


def test_frames_and_keyframes_are_read_back_to_the_last_bit(kept):
    folder, found, _ = kept
    read = read_journal(folder)
    assert [timestamp_s for timestamp_s, _ in read.frames] == [time_s for time_s, _ in found]
    for (_, now), (_, then) in zip(read.frames, found, strict=True):
        assert (now.keyframe_id, now.segment) == (then.keyframe_id, then.segment)
        assert now.covered == then.covered
        assert np.array_equal(now.T_kf_cam, then.T_kf_cam)
        assert np.array_equal(now.T_odom_cam, then.T_odom_cam)
        assert (now.new_keyframe is None) == (then.new_keyframe is None)
        assert now.moved.keys() == then.moved.keys()
        for k, T in then.moved.items():
            assert np.array_equal(now.moved[k], T)
        for link, other in zip(now.links, then.links, strict=True):
            assert (link.ref_id, link.query_id) == (other.ref_id, other.query_id)
            assert np.array_equal(link.motion.T_ref_query, other.motion.T_ref_query)
            information = other.motion.information
            np.testing.assert_allclose(link.motion.information, information, rtol=1e-9)


def test_loops_are_read_back(kept):
    folder, _, slam = kept
    attempts = [each for some in read_journal(folder).attempts.values() for each in some]
    assert len(attempts) == len(slam.attempts) > 0
    assert any(each.rejection is None for each in attempts)
    for now, then in zip(attempts, slam.attempts, strict=True):
        assert (now.query_id, now.match_id) == (then.query_id, then.match_id)
        assert now.similarity == then.similarity and now.rejection == then.rejection
        if then.verification:
            mask = then.verification.inlier_mask
            assert np.array_equal(now.verification.inlier_mask, mask)
        if then.rejection is None:
            assert np.array_equal(now.motion.T_ref_query, then.motion.T_ref_query)


def test_the_header_is_read_back(kept, sequence):
    folder, _, _ = kept
    assert read_journal(folder).header == header_of(sequence)


def test_the_certificate_is_kept_without_features_too(kept, tmp_path, certified):
    folder, _, slam = kept
    certificate = certified.result.calibration.certificate
    header = replace(read_journal(folder).header, certificate=certificate)
    with JournalWriter(tmp_path, header, slam):
        pass
    journal = read_journal(tmp_path)
    path = tmp_path / MEASUREMENTS
    write_measurements(path, Measurements(journal, None, None))
    for read in (journal, read_measurements(path, Config()).journal):
        assert read.header == header
        assert replayed(read, Config(), None).certificate == certificate


def test_trajectory_and_ledger_so_far_are_those_formats(kept, T_first_cam):
    folder, found, slam = kept
    so_far = read_tum(folder / "trajectory.txt")
    assert len(so_far) == len(found)
    assert np.abs(so_far.T_world_cam - T_first_cam)[:, :3, 3].max() < 0.1
    records = read_ledger(folder / "loops.jsonl")
    assert [each.query_id for each in records] == [each.query_id for each in slam.attempts]


@pytest.mark.parametrize("cut", [1, 10, 200, 2000])
def test_a_torn_end_costs_no_more_than_itself(kept, tmp_path, cut):
    content = (kept[0] / JOURNAL).read_bytes()
    (tmp_path / JOURNAL).write_bytes(content[:-cut])
    lines = content[:-cut].count(b"\n") + (cut == 1)
    read = read_journal(tmp_path)
    attempts = sum(map(len, read.attempts.values()))
    assert len(read.frames) + attempts + len(read.session_starts) == lines - 1


@pytest.mark.parametrize(
    "line", [b"\0\0\0\0", b"[]", b"7", b"{}", b'{"frame": 1}', b'{"loop": {"query": 0}}', b"\xff"]
)
def test_what_follows_a_line_that_is_none_is_not_believed(kept, tmp_path, line):
    lines = (kept[0] / JOURNAL).read_bytes().split(b"\n")
    (tmp_path / JOURNAL).write_bytes(b"\n".join([*lines[:5], line, *lines[5:]]))
    assert len(read_journal(tmp_path).frames) == 3  # after header and session


@pytest.mark.parametrize("content", [None, b"", b"{}", b"[1]", b'{"camera": 1}', b"\xff\xfe"])
def test_no_journal_is_one_clear_line(tmp_path, content):
    if content is not None:
        (tmp_path / JOURNAL).write_bytes(content)
    with pytest.raises(SlamError, match=r"nothing unfinished|does not say what run"):
        read_journal(tmp_path)


def test_a_pipe_is_no_journal(tmp_path):
    os.mkfifo(tmp_path / JOURNAL)
    with pytest.raises(SlamError, match=r"nothing unfinished to read: .* it is a pipe"):
        read_journal(tmp_path)


def test_it_is_on_disk_while_the_run_goes_on(tmp_path, sequence, monkeypatch):
    monkeypatch.setattr(journal, "_EVERY_S", 0.01)
    slam = Slam(sequence.camera, GradientRecognizer())
    with JournalWriter(tmp_path, header_of(sequence), slam) as writer:
        writer.add(journal.blank_preview(sequence.camera), Rejection("none", 0.0, 1.0))
        deadline = time.monotonic() + 30.0
        while not read_journal(tmp_path).frames and time.monotonic() < deadline:
            time.sleep(0.01)
        assert read_journal(tmp_path).frames == [(0.0, None)]


def test_a_run_is_worth_more_than_its_journal(tmp_path, sequence, monkeypatch):
    slam = Slam(sequence.camera, GradientRecognizer())
    folder = tmp_path / "unfinished"
    folder.mkdir()
    with JournalWriter(folder, header_of(sequence), slam) as writer:
        folder.rename(tmp_path / "gone")
        writer.add(journal.blank_preview(sequence.camera), Rejection("none", 0.0, 1.0))
    assert isinstance(writer.failure, FileNotFoundError)
