# SPDX-License-Identifier: Apache-2.0
import os
import signal
import sys

import pytest

from placerec.commands.fleet import LOCAL, Fleet, run_all
from placerec.errors import RecognizerError

HERE = Fleet(LOCAL, 1, 100)


def test_without_ray_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(RecognizerError, match=r"^[^\n]*pip install 'loopclose\[fleet\]'$"):
        run_all(len, ["a"], HERE, print)


@pytest.mark.parametrize("address", ["ray://127.0.0.1:1", "127.0.0.1:1", "127.0.0.1:x"])
def test_a_cluster_that_does_not_answer_is_one_line(address):
    with pytest.raises(RecognizerError, match=f"^cannot reach the cluster at {address}: "):
        run_all(len, ["a"], Fleet(address, 1, 100), print)


def test_a_task_whose_process_dies_is_done_again_and_one_that_fails_stops_no_other(tmp_path):
    ray = pytest.importorskip("ray", reason="needs Ray: pip install 'loopclose[fleet]'")

    def work(task):  # in here, for no other process can load this file
        if task == "dies":
            mark = tmp_path / "died"
            if not mark.exists():
                mark.touch()
                os.kill(os.getpid(), signal.SIGKILL)
        if task == "fails":
            raise ValueError("of no use")
        return task, os.environ["OMP_NUM_THREADS"], ray.util.get_node_ip_address()

    told = []
    run_all(work, ["dies", "fails"], HERE, told.append)
    ended = {each.number: each for each in told}
    assert ended[0].answer == ("dies", "1", "127.0.0.1")
    assert ended[1].answer is None and ended[1].why == "ValueError: of no use"
    assert not ray.is_initialized()
