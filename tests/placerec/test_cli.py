# SPDX-License-Identifier: Apache-2.0
import pytest

from placerec.cli import main


def test_check_prints_a_table_and_passes(capsys):
    assert main(["check", "placerec.gradients:GradientRecognizer"]) == 0
    out = capsys.readouterr().out
    assert "ok    shape (D,)" in out
    assert "FAIL" not in out


def test_check_of_a_class_in_the_current_folder_that_does_not_conform(
    tmp_path, monkeypatch, capsys
):
    (tmp_path / "draft_recognizer.py").write_text(
        "class Draft:\n    min_similarity = 0.5\n    def embed(self, x):\n        return x\n"
    )
    monkeypatch.chdir(tmp_path)
    assert main(["check", "draft_recognizer:Draft"]) == 1
    assert "FAIL  shape (D,)" in capsys.readouterr().out


def test_unknown_recognizer_is_one_line_and_bad_usage(capsys):
    assert main(["check", "no-such-thing"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("placerec: there is no recognizer 'no-such-thing'")
    assert error.count("\n") == 1


@pytest.mark.parametrize("arguments", [[], ["check"], ["bogus"]])
def test_bad_usage(arguments):
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2
