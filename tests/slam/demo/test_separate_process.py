# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys

import pytest

from slam.demo import render_sequence
from slam.demo.separate_process import render_apart
from slam.types import SlamError

pytestmark = pytest.mark.usefixtures("built_rooms")


def contents(folder):
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def render(folder, progress=lambda *_: None):
    render_apart(folder, progress, seconds=0.14)


def test_the_same_bytes_are_rendered_and_progress_is_told(tmp_path):
    seen = []
    render(tmp_path / "apart", lambda *counts: seen.append(counts))
    render_sequence(tmp_path / "here", seconds=0.14)
    assert contents(tmp_path / "apart") == contents(tmp_path / "here")
    assert seen == [(1, 2), (2, 2)]


def test_open3d_is_not_loaded_here():
    script = "import sys, slam.demo.separate_process; print('open3d' in sys.modules)"
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ran.stdout == "False\n"


def test_what_is_wrong_is_one_clear_line(tmp_path):
    (tmp_path / "thesis.txt").write_text("do not lose")
    with pytest.raises(SlamError, match="there is something already") as error:
        render(tmp_path)
    assert "\n" not in str(error.value) and str(error.value).endswith(str(tmp_path))


def test_a_mistake_of_ours_is_one_line_too(tmp_path):
    with pytest.raises(SlamError, match=r"^TypeError: .*'minutes'$"):
        render_apart(tmp_path / "sequence", lambda *_: None, minutes=1.0)


def test_an_interrupted_rendering_is_over_and_leaves_nothing_behind(tmp_path):
    def interrupt(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_apart(tmp_path / "sequence", interrupt, seconds=60.0)
    assert list(tmp_path.iterdir()) == []


def test_a_process_that_is_killed_is_told_of(tmp_path, monkeypatch):
    started = []

    class Process(subprocess.Popen):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            started.append(self)

    monkeypatch.setattr(subprocess, "Popen", Process)
    with pytest.raises(SlamError, match="was ended by SIGKILL"):
        render_apart(tmp_path / "sequence", lambda *_: started[0].kill(), seconds=60.0)
