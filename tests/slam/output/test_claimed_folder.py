# SPDX-License-Identifier: Apache-2.0
import errno
import os
import shutil
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import pytest

from slam.output.claimed_folder import JOURNAL, OUTPUTS, ClaimedFolder
from slam.types import SlamError


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def written(claimed, text, *names):
    claimed.start()
    for name in names:
        (claimed.unfinished / name).write_text(text)


SUMMARY = '{{"frames_tracked": 1, "files": {}, "of": "{}"}}'


def finish(folder, text, names):
    with ClaimedFolder(folder) as claimed:
        written(claimed, text, *names)
        files = str([*names]).replace("'", '"')
        (claimed.unfinished / "summary.json").write_text(SUMMARY.format(files, text))
        claimed.complete()


def test_a_folder_is_made_with_its_parents_and_goes_if_it_stays_empty(tmp_path):
    folder = tmp_path / "runs" / "desk"
    with ClaimedFolder(folder):
        assert names(folder) == []
    assert names(tmp_path) == []


def test_an_earlier_run_is_not_touched_by_claiming_its_folder(tmp_path):
    (tmp_path / "report.html").write_text("mine")
    with ClaimedFolder(tmp_path):
        pass
    assert names(tmp_path) == ["report.html"]


@pytest.mark.parametrize("inside", ["", "deeper"])
def test_a_file_in_the_way_is_one_clear_line(tmp_path, inside):
    (tmp_path / "taken").write_text("")
    folder = tmp_path / "taken" / inside
    with (
        pytest.raises(SlamError, match=r"cannot write to the output folder .*--out") as error,
        ClaimedFolder(folder),
    ):
        pass
    assert "\n" not in str(error.value) and str(error.value).endswith(str(folder))


def test_a_folder_that_may_not_be_written_to_is_one_clear_line(tmp_path, monkeypatch):
    def touch(path):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))

    monkeypatch.setattr(Path, "touch", touch)
    with pytest.raises(SlamError, match="Permission denied"), ClaimedFolder(tmp_path):
        pass


@pytest.mark.parametrize(
    "files",
    [
        ("rgb.txt",),
        ("color/000000.png", "depth/000000.png", "camera_intrinsic.json"),
        ("frame-000000.color.png", "frame-000000.depth.png"),
        ("results/frame000000.jpg", "results/depth000000.png"),
        ("metadata.yaml", "recording.db3"),
    ],
)
def test_a_recording_of_any_format_is_no_run_folder(tmp_path, files):
    for name in files:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    before = names(tmp_path)
    with pytest.raises(SlamError, match="replace files of the recording"), ClaimedFolder(tmp_path):
        pass
    assert names(tmp_path) == before


def test_two_runs_do_not_share_a_folder(tmp_path):
    told = "another run is writing into the output folder"
    with ClaimedFolder(tmp_path), pytest.raises(SlamError, match=told), ClaimedFolder(tmp_path):
        pass
    with ClaimedFolder(tmp_path):  # what was claimed once can be claimed again
        pass


def test_a_claim_ends_with_its_process(tmp_path):
    code = (
        "import os, signal, sys; from pathlib import Path;"
        "from slam.output.claimed_folder import ClaimedFolder;"
        "ClaimedFolder(Path(sys.argv[1])).__enter__(); os.kill(os.getpid(), signal.SIGKILL)"
    )
    killed = subprocess.run([sys.executable, "-c", code, str(tmp_path)], check=False)
    assert killed.returncode == -9
    with ClaimedFolder(tmp_path):
        pass


def test_files_of_an_earlier_run_go_and_others_stay(tmp_path):
    finish(tmp_path, "old", ["trajectory.txt", "map.ply"])
    (tmp_path / "notes.txt").write_text("mine")
    finish(tmp_path, "new", ["trajectory.txt"])
    assert names(tmp_path) == ["notes.txt", "summary.json", "trajectory.txt"]
    assert (tmp_path / "trajectory.txt").read_text() == "new"


def steps(monkeypatch, stop_after):
    """Let whatever changes the folder's entries end the process, as it seems, after some steps."""
    left = iter(range(stop_after))

    def counted(usual):
        def step(*arguments, **options):
            if next(left, None) is None:
                raise SystemExit("killed")
            return usual(*arguments, **options)

        return step

    for owner, name in ((Path, "replace"), (Path, "unlink"), (shutil, "rmtree")):
        monkeypatch.setattr(owner, name, counted(getattr(owner, name)))


@pytest.mark.parametrize("stop_after", range(12))
def test_who_is_killed_at_any_step_never_leaves_files_of_two_runs(
    tmp_path, monkeypatch, stop_after
):
    old, new = ["trajectory.txt", "map.ply", "settings.toml"], ["trajectory.txt", "report.html"]
    finish(tmp_path, "old", old)
    with ClaimedFolder(tmp_path) as claimed:
        written(claimed, "new", *new)
        text = SUMMARY.format('["trajectory.txt", "report.html"]', "new")
        (claimed.unfinished / "summary.json").write_text(text)
        with monkeypatch.context() as patched:
            steps(patched, stop_after)
            with suppress(SystemExit):
                claimed.complete()
    found = {path.read_text() for path in tmp_path.iterdir() if path.name in OUTPUTS}
    assert len({"old" if "old" in text else "new" for text in found}) <= 1
    with ClaimedFolder(tmp_path) as claimed:  # the next one completes what was written whole
        if not claimed.unfinished.exists():
            assert names(tmp_path) == ["report.html", "summary.json", "trajectory.txt"]
            assert all("new" in path.read_text() for path in tmp_path.iterdir())


def test_pipes_called_like_outputs_are_somebody_s(tmp_path):
    for name in ("summary.json", "settings.toml"):
        os.mkfifo(tmp_path / name)
    with ClaimedFolder(tmp_path) as claimed, pytest.raises(SlamError, match=r"settings\.toml that"):
        claimed.refuse_foreign(OUTPUTS)


def test_what_killed_runs_left_of_single_files_is_removed(tmp_path):
    (tmp_path / ".summary.json.4711.part").touch()
    (tmp_path / ".thesis.tex.4711.part").touch()
    (tmp_path / ".rendering-abc").mkdir()
    with ClaimedFolder(tmp_path):
        pass
    assert names(tmp_path) == [".thesis.tex.4711.part"]


def test_a_folder_of_somebody_s_called_unfinished_is_left_alone(tmp_path):
    (tmp_path / "unfinished").mkdir()
    (tmp_path / "unfinished" / "symphony.txt").touch()
    with (
        ClaimedFolder(tmp_path) as claimed,
        pytest.raises(SlamError, match="which no run has left"),
    ):
        claimed.start()
    assert names(tmp_path / "unfinished") == ["symphony.txt"]


def test_what_a_killed_run_left_is_told_and_replaced(tmp_path):
    with ClaimedFolder(tmp_path) as claimed:
        assert not claimed.start()
        (claimed.unfinished / "trajectory.txt").write_text("so far")
    with ClaimedFolder(tmp_path) as claimed:
        assert claimed.start()
        assert names(claimed.unfinished) == [JOURNAL]


def test_a_file_put_there_meanwhile_is_not_written_over(tmp_path):
    with ClaimedFolder(tmp_path) as claimed:
        written(claimed, "new", "trajectory.txt")
        (tmp_path / "trajectory.txt").write_text("mine")
        with pytest.raises(SlamError, match=r"holds a trajectory\.txt"):
            claimed.complete()
        assert (claimed.unfinished / "trajectory.txt").read_text() == "new"
    assert (tmp_path / "trajectory.txt").read_text() == "mine"
