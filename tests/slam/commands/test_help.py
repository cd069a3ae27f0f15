# SPDX-License-Identifier: Apache-2.0
import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    ("module", "typed", "taught"),
    [
        ("slam.__main__", ["batch", "--help"], "run_slam batch recordings/*"),
        ("slam.__main__", ["compare", "--help"], "run_slam compare runs/demo runs/strict"),
        ("slam.__main__", ["merge", "--help"], "run_slam merge maps/robot1 maps/robot2"),
        ("slam.__main__", ["more-loops", "--help"], "run_slam more-loops runs/fr1_desk"),
        ("slam.__main__", ["reembed", "--help"], "run_slam reembed maps/desk --recognizer"),
        ("slam.__main__", ["replay", "--help"], "run_slam replay runs/fr1_desk"),
        ("slam.__main__", ["stress", "--help"], "run_slam stress demo"),
        ("slam.commands.drift_report", ["--help"], "drift_report estimate.txt truth.txt"),
    ],
    ids=["batch", "compare", "merge", "more-loops", "reembed", "replay", "stress", "drift_report"],
)
def test_help_teaches_on_one_screen_and_loads_nothing_heavy(monkeypatch, module, typed, taught):
    script = (
        "import sys\n"
        f"from {module} import main\n"
        "try:\n"
        f"    main({typed})\n"
        "except SystemExit as exited:\n"
        "    print(exited.code, sorted(sys.modules), file=sys.stderr)\n"
    )
    monkeypatch.setenv("COLUMNS", "80")
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    lines = done.stdout.splitlines()
    assert len(lines) <= 24 and max(map(len, lines)) <= 80
    assert f"  {taught}" in done.stdout
    assert done.stderr.startswith("0 ")
    assert not any(f"'{name}'" in done.stderr for name in ("matplotlib", "numba", "cv2", "torch"))
