# SPDX-License-Identifier: Apache-2.0
"""What docs/place_store.md shows works as it stands there."""

import re
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "place_store.md").read_text()


def test_its_code_finds_the_place(tmp_path, monkeypatch, capsys, needs_lancedb):
    monkeypatch.chdir(tmp_path)
    (code,) = re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL)
    images = np.random.default_rng(0).integers(0, 256, (3, 60, 80, 3), np.uint8)
    given = {"images": images, "image": images[1], "times_s": [0.0, 1.0, 40.0]}
    exec(code, {**given, "keyframes": [4, 5, 6]})
    session, keyframe, time_s, similarity = capsys.readouterr().out.splitlines()[0].split()
    assert (session, keyframe, time_s) == ("robot7/2026-11-30", "5", "1.0")
    assert float(similarity) == pytest.approx(1.0, abs=1e-5)
