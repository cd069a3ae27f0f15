# SPDX-License-Identifier: Apache-2.0
import csv
import pickle
import re
import shutil
import sys
from dataclasses import fields
from importlib.metadata import version

import pytest

from placerec.__main__ import main
from placerec.certificate import read_certificate
from placerec.commands import evaluate
from placerec.commands.fleet import Finished
from placerec.recognizer import load
from placerec.training.config import TrainingConfig


def test_check_prints_a_table_and_passes(capsys):
    assert main(["check", "placerec.recognizers.gradients:GradientRecognizer"]) == 0
    out = capsys.readouterr().out
    assert "\n  ok    one shape                        (496,)\n" in out
    assert re.search(r"\n {8}to embed 640x480                 \d+\.\d ms\n", out)
    assert "\n        to keep 10,000                   19.8 MB, 2.0 kB each\n" in out
    assert out.endswith("\nall checks passed\n")


def test_check_of_a_class_in_the_current_folder_that_does_not_conform(
    tmp_path, monkeypatch, capsys
):
    (tmp_path / "draft_recognizer.py").write_text(
        "class Draft:\n    min_similarity = 0.5\n    def embed(self, x):\n        return x\n"
    )
    monkeypatch.chdir(tmp_path)
    assert main(["check", "draft_recognizer:Draft"]) == 1
    out = capsys.readouterr().out
    assert "\n  FAIL  one shape                        (480, 640, 3)\n" in out
    assert "\n                                         -> return (D,) for every image: " in out
    assert "\n  --    3 more                           first mend 'one shape'\n" in out
    assert "to embed" not in out
    assert out.endswith("\n2 of 37 checks failed, 27 not tried\n")


def test_unknown_recognizer_is_one_line_and_bad_usage(capsys):
    assert main(["check", "no-such-thing"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("placerec: there is no recognizer 'no-such-thing'")
    assert error.count("\n") == 1


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ([], "Expected one of {check, embed, evaluate, calibrate, fit, train, adapt, export}"),
        (["check"], "NAME|MODULE:CLASS|FILE"),
        (["bogus"], "bogus"),
        (["train", "x", "--out", "y", "--alpa", "3"], "perhaps you meant --alpha"),
        (["train", "x", "--out", "y", "--batch-sets", "0"], "--batch-sets 0: input should be"),
        (["train", "x", "--out", "y", "--size", "3"], "--size"),
    ],
)
def test_bad_usage_is_one_line_that_names_what_was_typed(arguments, told, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith("placerec: ") and told in error
    assert error.count("\n") == 1 and "│" not in error


GRADIENTS = "placerec.recognizers.gradients:GradientRecognizer"


@pytest.fixture
def drives(tmp_path, write_image):
    """Write two drives past five places, 5 images each; the second picture of ref/ is broken."""
    for i in range(5):
        write_image(tmp_path / f"drives/query/{i}.png", seed=i)
        write_image(tmp_path / f"drives/ref/{i}.png", seed=i)
    (tmp_path / "drives/ref/1.png").write_bytes(b"oh")
    rows = "".join(f"{i},{i}\n" for i in range(5))
    (tmp_path / "drives/ground_truth.csv").write_text(f"query,refs\n{rows}")
    return str(tmp_path / "drives")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    """Write nothing into the folder that the tests are started in, and nothing into the cache."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.chdir(tmp_path)


def test_evaluate_prints_a_table_and_names_what_it_skipped(drives, capsys):
    assert main(["evaluate", drives, drives, "--recognizers", GRADIENTS]) == 0
    shown = capsys.readouterr()
    assert "drives: 9 images (1 skipped), 20 pairs count, 4 of them show one place" in shown.out
    assert "4 of 5 queries have a match" in shown.out
    rows = [line for line in shown.out.splitlines() if line.startswith(f"| drives | {GRADIENTS} |")]
    assert len(rows) == 2
    assert [cell.strip() for cell in rows[0].split("|")[3:5]] == ["1.000", "1.000"]
    assert f"skipped: not a readable image: {drives}/ref/1.png" in shown.err


def figures(out):
    return list(csv.DictReader((out / "results.csv").read_text().splitlines()))


def test_evaluate_leaves_a_page_and_the_figures(drives, tmp_path, capsys):
    out = tmp_path / "new" / "evaluation"
    assert main(["evaluate", drives, "--recognizers", GRADIENTS, "--out", str(out)]) == 0
    assert sorted(path.name for path in out.iterdir()) == ["index.html", "results.csv"]
    (row,) = figures(out)
    assert (row["data"], row["recognizer"], row["average_precision"]) == (
        "drives",
        GRADIENTS,
        "1.0",
    )
    assert "<h2>drives</h2>" in (out / "index.html").read_text()
    assert str(out / "index.html") in capsys.readouterr().out


def test_evaluate_looks_a_second_time_where_asked(drives, tmp_path, capsys):
    out = tmp_path / "again"
    arguments = ["evaluate", drives, "--recognizers", GRADIENTS, "--out", str(out)]
    assert main([*arguments, "--second-look"]) == 0
    names = [row["recognizer"] for row in figures(out)]
    assert names == [GRADIENTS, f"{GRADIENTS}, second look"]


def test_the_second_time_embeddings_are_taken_from_the_cache_unless_told_otherwise(
    drives, tmp_path, later_run, capsys
):
    arguments = ["evaluate", drives, "--recognizers", GRADIENTS, "--out", str(tmp_path / "out")]
    timed_on = []
    for more in ([], [], ["--no-cache"]):
        assert main([*arguments, *more]) == 0
        later_run()
        timed_on.append(figures(tmp_path / "out")[0]["embed_timed_on"])
    assert [bool(day) for day in timed_on] == [False, True, False]
    assert capsys.readouterr().out.count("* timed when the kept embeddings were made") == 1


@pytest.fixture
def installed(tmp_path):
    """Write a module of recognizers: one that cannot be made, and one that fails at work."""
    (tmp_path / "frail.py").write_text(
        "class Unmade:\n    def __init__(self):\n        raise OSError('no weights')\n"
        "class Unfit:\n    min_similarity = 0.5\n"
        "    def embed(self, image):\n        raise ValueError('not today')\n"
    )
    return ("frail:Unmade", "frail:Unfit", GRADIENTS)


def test_of_all_that_are_installed_one_that_fails_does_not_stop_the_others(
    drives, installed, monkeypatch, tmp_path, capsys
):
    monkeypatch.setattr(evaluate, "available", lambda: installed)
    assert main(["evaluate", drives, "--out", str(tmp_path / "out")]) == 1
    out = capsys.readouterr().out
    assert "failed: recognizer 'frail:Unmade' cannot be constructed: OSError: no weights" in out
    assert "failed: recognizer 'Unfit' failed: ValueError: not today" in out
    rows = figures(tmp_path / "out")
    assert [bool(row["failure"]) for row in rows] == [True, True, False]
    assert rows[2]["average_precision"] == "1.0"


def test_of_all_that_are_installed_one_without_weights_here_is_left_out_and_said(
    drives, installed, monkeypatch, tmp_path, capsys
):
    monkeypatch.setattr(evaluate, "available", lambda: ("frail:Unmade", GRADIENTS))
    assert main(["evaluate", drives, "--out", str(tmp_path / "out")]) == 0
    assert "frail:Unmade" in capsys.readouterr().out
    assert "no weights" in (tmp_path / "out" / "index.html").read_text()


def test_all_may_stand_beside_others_each_counted_once(drives, monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(evaluate, "available", lambda: (GRADIENTS,))
    assert main(["evaluate", drives, "--recognizers", "all", GRADIENTS]) == 0
    assert len(figures(tmp_path / "runs" / "evaluation")) == 1


def test_what_is_wrong_is_found_before_the_work(drives, tmp_path, monkeypatch, installed, capsys):
    monkeypatch.setattr(evaluate, "measure", lambda *_, **__: pytest.fail("this is the work"))
    (tmp_path / "file").write_text("")
    wrong = [
        ([drives, "--recognizers", GRADIENTS, "frail:Unmade"], "cannot be constructed: OSError"),
        ([drives, "missing", "--recognizers", GRADIENTS], "there is no such folder"),
        ([drives, "--recognizers", GRADIENTS, "--out", "file"], "cannot make the folder"),
        ([f"{drives}/query+{drives}/ref:9", "--recognizers", GRADIENTS], "nothing can be measured"),
    ]
    for arguments, message in wrong:
        assert main(["evaluate", *arguments]) == 2
        error = capsys.readouterr().err.splitlines()[-1]
        assert error.startswith("placerec: ")
        assert message in error


def test_a_fleet_measures_what_one_process_does(
    drives, tmp_path, monkeypatch, later_run, installed, capsys
):
    def run_all(work, tasks, fleet, tell):
        assert fleet.address == "local"
        for number, task in reversed(list(enumerate(tasks))):
            monkeypatch.chdir("/")  # as on another machine
            tell(
                pickle.loads(pickle.dumps(Finished(number, work(pickle.loads(pickle.dumps(task))))))
            )
        monkeypatch.chdir(tmp_path)

    monkeypatch.setattr(evaluate, "run_all", run_all)
    monkeypatch.setattr(evaluate, "available", lambda: installed)
    shutil.copytree(drives, tmp_path / "more")
    asked = ["evaluate", "drives", "more", "--out"]
    assert main([*asked, "alone"]) == 1
    alone = capsys.readouterr().out
    later_run()
    assert main([*asked, "many", "--address", "local"]) == 1
    assert "drives: 9 images (1 skipped), 20 pairs" in capsys.readouterr().out and alone
    times = ("embed_ms", "embed_timed_on", "compare_ms")
    one, other = (
        [{k: v for k, v in row.items() if k not in times} for row in figures(tmp_path / each)]
        for each in ("alone", "many")
    )
    assert one == other and [row["data"] for row in one] == [*["drives"] * 3, *["more"] * 3]
    assert figures(tmp_path / "many")[2]["embed_timed_on"]  # not embedded again


def test_data_whose_process_died_failed_and_stop_no_other(drives, monkeypatch, tmp_path, capsys):
    def run_all(work, tasks, fleet, tell):
        tell(Finished(1, None, "the worker died"))
        tell(Finished(0, work(tasks[0])))

    monkeypatch.setattr(evaluate, "run_all", run_all)
    shutil.copytree(drives, tmp_path / "more")
    asked = ["evaluate", drives, "more", "--recognizers", GRADIENTS, "--address", "local"]
    assert main([*asked, "--out", "out"]) == 1
    assert [row["failure"] for row in figures(tmp_path / "out")] == ["", "the worker died"]


def test_stopping_an_evaluation_is_one_line(drives, monkeypatch, capsys):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(evaluate, "measure", interrupted)
    assert main(["evaluate", drives, "--recognizers", GRADIENTS]) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("placerec: stopped; ")


def test_calibrate_writes_a_certificate(drives, tmp_path, capsys):
    out = tmp_path / "gradients.json"
    assert main(["calibrate", drives, "--recognizer", GRADIENTS, "--out", str(out)]) == 0
    certificate = read_certificate(out)
    assert certificate.recognizer == GRADIENTS
    (kind,) = certificate.kinds
    assert (kind.pairs, kind.skipped, certificate.recall) == (20, 1, 1.0)
    shown = capsys.readouterr().out
    assert "drives: 9 images (1 skipped), 20 pairs count, 4 of them show one place" in shown
    assert f"worth verifying from {certificate.min_similarity:.4f} (95 % interval " in shown
    assert f"taken for one place from {certificate.threshold:.4f} (" in shown
    assert "left out" not in shown
    assert shown.endswith(f"certificate written to {out}\n")


def test_calibrate_tries_each_kind_of_scene_on_the_terms_of_the_others(drives, tmp_path, capsys):
    for name in ("a", "b"):
        shutil.copytree(drives, tmp_path / "walks" / name)
    arguments = ["calibrate", drives, str(tmp_path / "walks"), "--recognizer", GRADIENTS]
    assert main([*arguments, "--out", "it.json"]) == 0
    certificate = read_certificate(tmp_path / "it.json")
    assert [(kind.data, kind.pairs) for kind in certificate.kinds] == [
        ("drives", 20),
        ("walks", 40),
    ]
    shown = capsys.readouterr().out
    verified, believed = (
        getattr(certificate.kinds[1], name) for name in ("left_out_to_verify", "left_out_tau")
    )
    assert (
        f"walks: 18 images (2 skipped), 40 pairs count, 8 of them show one place\n"
        f"  left out, worth verifying from {verified.threshold:.4f}: of different places "
        f"{verified.different_places:.2%} pass, of one place 0.0% are cut\n"
        f"  left out, taken for one place from {believed.threshold:.4f}: "
    ) in shown


def test_calibrate_says_that_a_certificate_needs_a_place_before_it_starts(capsys):
    assert main(["calibrate", "no-folder", "--recognizer", GRADIENTS]) == 2
    assert capsys.readouterr().err == (
        f"placerec: {GRADIENTS} is no file of weights that a certificate could lie beside; say "
        "with --out FILE.json where to write it\n"
    )


def test_an_onnx_file_is_calibrated_by_a_certificate_beside_it(
    drives, tmp_path, write_onnx, capsys
):
    network = str(write_onnx(tmp_path / "net.onnx"))
    assert main(["calibrate", drives, "--recognizer", network]) == 0
    path = tmp_path / "net.certificate.json"
    assert capsys.readouterr().out.endswith(f"min_similarity is taken from, written to {path}\n")
    assert load(network).min_similarity == read_certificate(path).min_similarity
    assert read_certificate(path).recognizer == "net.onnx"


def test_without_what_runs_an_onnx_file_the_code_is_2(tmp_path, write_onnx, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    assert main(["check", str(write_onnx(tmp_path / "net.onnx"))]) == 2
    error = capsys.readouterr().err
    assert "pip install onnxruntime" in error and error.count("\n") == 1


def test_calibrate_hears_each_kind_of_scene_once(drives, capsys):
    twice = ["calibrate", drives, drives, "--recognizer", GRADIENTS, "--out", "y"]
    assert main(twice) == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert error == "placerec: drives is named twice; each kind of scene has one say"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate"], "evaluate needs at least one folder"),
        (["evaluate", "no-folder", "--recognizers", GRADIENTS], "there is no such folder"),
        (["evaluate", "no-folder", "--recognizers", "bogus"], "there is no recognizer 'bogus'"),
        (["calibrate", "x", "--recognizer", GRADIENTS, "--out", "y"], "there is no such folder"),
        (["calibrate", "--recognizer", GRADIENTS, "--out", "y"], "calibrate needs at least one"),
    ],
)
def test_bad_input_is_one_line_and_code_2(arguments, message, capsys):
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"placerec: {message}")
    assert error.count("\n") == 1


def printed_at_exit(arguments, capsys):
    """Return what a command prints that ends with its help or the like."""
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert not caught.value.code
    printed = capsys.readouterr()
    assert printed.err == ""
    return printed.out


@pytest.mark.parametrize(
    "command", ["check", "embed", "evaluate", "calibrate", "fit", "train", "adapt", "export"]
)
def test_help_fits_on_a_screen_and_shows_an_example_or_what_is_needed(command, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    shown = printed_at_exit([command, "--help"], capsys)
    assert "MODULE:CLASS" in shown or f"Example: placerec {command} " in shown
    lines = shown.splitlines()
    assert len(lines) <= 36 and max(map(len, lines)) <= 80
    assert "--alpha" not in shown and "--help-all" in shown


def test_help_lists_the_commands_each_in_a_line(capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    lines = printed_at_exit(["-h"], capsys).splitlines()
    assert len(lines) <= 24 and max(map(len, lines)) <= 80
    begins = [line.split()[0] for line in lines if line.startswith("  ")]
    assert begins[:8] == [
        "check",
        "embed",
        "evaluate",
        "calibrate",
        "fit",
        "train",
        "adapt",
        "export",
    ]


def test_help_all_shows_every_setting(capsys):
    shown = printed_at_exit(["train", "--help-all"], capsys)
    for each in fields(TrainingConfig):
        assert f"--{each.name.replace('_', '-')} " in shown.replace(",", " ")


def test_the_version_is_that_of_the_package(capsys):
    assert printed_at_exit(["--version"], capsys) == f"placerec {version('loopclose')}\n"
    assert printed_at_exit(["train", "--version"], capsys).startswith("placerec ")


def test_completion_is_a_script_with_the_flags(capsys):
    shown = printed_at_exit(["--completion", "bash"], capsys)
    assert "--batch-sets" in shown and "complete " in shown


# How much is said


def test_quiet_leaves_only_warnings(drives, tmp_path, capsys):
    assert main(["evaluate", "-q", drives, "--recognizers", GRADIENTS]) == 0
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err == f"warning: skipped: not a readable image: {drives}/ref/1.png\n"
    assert (tmp_path / "runs/evaluation/results.csv").exists()


def test_what_other_libraries_warn_of_is_shown_on_request(tmp_path, capsys, drives):
    (tmp_path / "noisy.py").write_text(
        "import logging, warnings\nimport numpy as np\n"
        "class Noisy:\n    min_similarity = 0.5\n"
        "    def embed(self, image):\n"
        "        warnings.warn('odd \\x1b[31mweights', stacklevel=1)\n"
        "        logging.getLogger('theirs').error('no cache')\n"
        "        return np.array([0.6, 0.8], np.float32)\n"
    )
    command = ["evaluate", drives, "--recognizers", "noisy:Noisy"]
    assert main(command) == 0
    err = capsys.readouterr().err
    assert "odd" not in err and "no cache" not in err
    assert main(["-v", *command]) == 0
    err = capsys.readouterr().err
    assert "UserWarning: odd \\x1b[31mweights" in err and "error: no cache\n" in err
    assert "\x1b" not in err and "Noisy on drives: 9 of 9" in err


# Data by name


def test_data_is_found_by_name_as_run_slam_finds_it(drives, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("LOOPCLOSE_DATA", str(tmp_path))
    monkeypatch.chdir(tmp_path / "drives")
    apart = ["--recognizers", GRADIENTS, "--out", str(tmp_path / "out")]
    assert main(["evaluate", "drives", "drives/query+drives/ref:0", *apart]) == 0
    assert [row["data"] for row in figures(tmp_path / "out")] == ["drives", "query+ref"]
    assert main(["evaluate", "fr1_desk", *apart]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == (
        "placerec: this sequence is not at hand; `run_slam fr1_desk` fetches it, or set "
        "LOOPCLOSE_DATA to the folder that it is in: fr1_desk"
    )
