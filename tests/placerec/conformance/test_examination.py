# SPDX-License-Identifier: Apache-2.0
import math
from pathlib import Path

import numpy as np
import pytest

from placerec.conformance import check
from placerec.conformance.examination import CHECKS, Examination
from placerec.conformance.subject import Verdict
from placerec.recognizer import load

HERE = Path(__file__).parent
MODULE = "faulty_recognizers"

# By whom each fault is caught, and how what was measured begins.
FAULTS = {
    "Raises": ("returns numbers", "OSError: no weights (faulty_recognizers.py:"),
    "ReturnsNothing": ("returns numbers", "a NoneType, which is not an array of numbers"),
    "ReturnsText": ("returns numbers", "a str, which is not an array of numbers"),
    "ReturnsNoValues": ("returns numbers", "0 of them"),
    "Degrees": ("its other members", "recognizer 'Degrees' has min_similarity = 25.0; it must lie"),
    "NoThreshold": ("its other members", "recognizer 'NoThreshold' has min_similarity = None"),
    "CompareIsNoMethod": ("its other members", "recognizer 'CompareIsNoMethod' has a compare that"),
    "LooksAhead": ("its other members", "recognizer 'LooksAhead' has looks_back = -1; it must be"),
    "BatchOfOne": ("one shape", "(1, 49)"),
    "SizeOfContent": ("one shape", "(4,) and (7,) and (8,)"),
    "Double": ("float32", "float64"),
    "ReturnsList": ("float32", "a list"),
    "NotANumber": ("finite", "6 of 294 values are NaN or infinite"),
    "Long": ("unit length", "lengths 2 to 2"),
    "NeedsColour": ("grey and empty images", "grey: ZeroDivisionError: no saturation (faulty_"),
    "NeedsLight": ("grey and empty images", "black: a vector of length 0"),
    "NeedsVga": ("images of any size", "319x241: ValueError: cannot reshape array"),
    "SizeOfImage": ("images of any size", "319x241: shape (290,), of others (529,)"),
    "Scribbles": ("leaves the image alone", "1920 values changed"),
    "Chatty": ("prints nothing", r"24 characters: 'embedding (480, 640, 3)\n'"),
    "Moody": ("the same image again", "3 of 3 differ by up to "),
    "Remembers": ("whatever came before", "6 of 6 differ by up to 0.0"),
    "TiedToItsThread": ("in another thread", "RuntimeError: made in another thread (faulty_"),
    "SharedBuffer": ("in several threads at once", ""),
    "TurnedRound": ("several at once", "differ by up to 0."),
    "LeavesOut": ("several at once", "5 of 6 embeddings, or others in shape"),
    "OtherEveryTime": ("by a second instance", "3 of 3 differ by up to "),
    "OtherEveryRun": ("in a fresh process", "6 of 6 differ by up to "),
    "OnlyHere": ("in a fresh process", f"recognizer '{MODULE}:OnlyHere' cannot be constructed: OS"),
    "Transposes": (
        "similarities from -1 to 1",
        "similarities of shape (12, 11), not (queries, re",
    ),
    "Distances": ("similarities from -1 to 1", "a similarity of 10; it must lie from -1 to 1"),
    "NoNumbers": (
        "similarities from -1 to 1",
        "similarities of shape (), not (queries, refer",
    ),
    "DividesByZero": ("similarities from -1 to 1", "ZeroDivisionError: no words (faulty_"),
    "Centres": ("leaves embeddings alone", "288 values changed"),
    "LooksFurtherBack": ("queries one at a time", "largest difference 0.0"),
    "UnlikeItself": ("whichever others are there", "0.1215 among 48 references, 1 among 96"),
    "Blind": ("unlike pictures are unlike", "the least alike of them: 1.0000, "),
    "Glares": ("darker and brighter", ""),
    "Edges": ("shifted by 16 pixels", "3 of 6 found; similarity at least -0."),
    "Hoards": ("keeps no images", "0.8"),
}

# Mistakes that people make: by which check each is caught, what was measured, what to do.
MISTAKES = {
    "Softmax": ("whichever others are there", " among 112 references, ", "no softmax"),
    "SharesOfTheBest": ("whichever others are there", "1 among 48 references, ", "or maximum"),
    "Collapsed": ("unlike pictures are unlike", "of them: 0.9999, 0.98 is", "subtract what all"),
    "Unreachable": ("min_similarity can be reached", "0 of 18 reach 0.9999999: ", "is too high"),
    "PassesAll": ("min_similarity keeps others out", "66 of 66 pairs reach 0.2: ", "is too low"),
    "SeedsNumpy": ("leaves random numbers alone", "numbers of numpy.random are", "your own np."),
    "SeedsTorch": ("leaves random numbers alone", "numbers of torch are", "torch.Generator()"),
    "Stale": ("after many images", "the answer to another image", "a cache that is full"),
    "Stuck": ("after many images", "the answer to another image", "keep no answers"),
    "Ring": ("after many images", "3 of 9 differ by", "a ring that has come round"),
    "OneCorner": ("sees all of the image", "4 of 9 parts change", "crop by image.shape[:2]"),
    "AbsoluteCosine": ("the opposite is unlike", "to its opposite 1.000", "as it is"),
    "ZeroInTheDark": ("grey and empty images", "black: a vector of length 0", "append 1e-3 to v"),
    "DarkIsNaN": ("grey and empty images", "black: values that are NaN", "add 1e-6 to a std"),
    "ExpectsFractions": ("sees all of the image", "2 of 9 parts change", "pixels by 255"),
    "HalfPrecision": ("unit length", "lengths 0 to 0", "np.append(v, 1e-3)"),
    "InPlace": ("leaves the image alone", " values changed", "image.copy()"),
    "OneBuffer": ("gives its answer away", "577 of 577 values changed", "embedding.copy()"),
    "RunningMean": ("the same image again", "3 of 3 differ by", "keep nothing on self"),
    "Dropout": ("the same image again", "3 of 3 differ by", "put a network in eval()"),
    "FixedSize": ("at half the size", "1 of 6 found", "resize every image to one size"),
    "NeedsRowsInOrder": ("however it lies in memory", "BGR turned round: ValueError", "np.array("),
    "ChangesFolder": ("leaves the program's settings", "folder is now /", "use full paths"),
    "SilencesNumpy": ("leaves the program's settings", "'divide': 'ignore'", "np.errstate("),
    "IndexesOnce": ("other references, other answers", "0 of 36 change", "index of the references"),
    "Squeezes": ("similarities from -1 to 1", "of shape (), not", "returns (Q, R)"),
    "DividesByLength": ("similarities from -1 to 1", "that are NaN", "divide by max(norm(v)"),
    "Smooths": ("queries one at a time", "largest difference 0.5", "let looks_back say"),
    "ReturnsDistances": ("an image itself", "0 of 6 found", "a distance d is the similarity 1 - d"),
}


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.syspath_prepend(HERE)


def examined(class_name):
    name = f"{MODULE}:{class_name}"
    return check(load(name), name)


def test_a_sound_recognizer_passes_every_check():
    report = examined("Sound")
    assert [finding.verdict for finding in report.findings] == [Verdict.PASSED] * len(CHECKS)
    assert report.passed


def test_one_that_compares_by_itself_needs_no_unit_length_and_passes_all_the_rest():
    report = examined("Maps")
    assert report.passed, str(report)
    (untried,) = [one for one in report.findings if one.verdict is Verdict.NOT_TRIED]
    assert untried.check.name == "unit length"


@pytest.mark.parametrize("recognizer", ["gradients", "learned"])
def test_what_is_built_in_passes_every_check(recognizer):
    report = check(load(recognizer), recognizer)
    assert report.passed, str(report)
    assert {finding.verdict for finding in report.findings} == {Verdict.PASSED}


@pytest.mark.parametrize("recognizer", FAULTS)
def test_a_fault_is_caught_by_the_check_meant_for_it_and_no_other(recognizer):
    caught_by, measured = FAULTS[recognizer]
    report = examined(recognizer)
    assert not report.passed
    (found,) = [finding for finding in report.findings if finding.failed]
    assert (found.check.name, found.measured[: len(measured)]) == (caught_by, measured), str(report)
    assert "\n" not in found.measured


@pytest.mark.parametrize("recognizer", MISTAKES)
def test_a_mistake_is_caught_once_with_what_was_measured_and_what_to_do(
    recognizer, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)  # one of them changes it
    caught_by, measured, remedy = MISTAKES[recognizer]
    with np.errstate():  # and one of them these
        report = check(load(f"wrong_recognizers:{recognizer}"))
    (found,) = [finding for finding in report.findings if finding.failed]
    assert found.check.name == caught_by, str(report)
    assert measured in found.measured
    assert remedy in found.check.remedy


@pytest.mark.parametrize("recognizer", ["Layout", "GradientRecognizer"])
def test_what_the_mistakes_were_made_in_passes(recognizer):
    report = check(load(f"wrong_recognizers:{recognizer}"))
    assert report.passed, str(report)


def test_a_threshold_that_few_views_or_most_pictures_reach_is_doubted(monkeypatch):
    recognizer = load(f"{MODULE}:Maps")
    for threshold, name in (
        (0.95, "min_similarity can be reached"),
        (0.155, "min_similarity keeps others out"),
    ):
        monkeypatch.setattr(type(recognizer), "min_similarity", threshold)
        report = check(recognizer)
        assert report.passed, str(report)
        assert outcomes(report)[name].verdict is Verdict.DOUBTFUL


def test_there_is_no_check_that_cannot_fail():
    caught_by = {caught_by for caught_by, *_ in (*FAULTS.values(), *MISTAKES.values())}
    assert caught_by == {check.name for check in CHECKS}


def outcomes(report):
    return {finding.check.name: finding for finding in report.findings}


def test_what_is_wrong_is_told_once():
    found = outcomes(examined("Raises"))
    assert found.pop("returns numbers").failed
    assert found.pop("its other members").verdict is Verdict.PASSED
    assert {one.measured for one in found.values()} == {"first mend 'returns numbers'"}
    assert {one.verdict for one in found.values()} == {Verdict.NOT_TRIED}


def test_without_a_name_no_other_one_is_made_and_the_rest_is_tried():
    report = check(load(f"{MODULE}:OtherEveryTime"))
    assert report.passed
    untried = [one for one in report.findings if one.verdict is Verdict.NOT_TRIED]
    assert [one.check.name for one in untried] == [
        "by a second instance",
        "in a fresh process",
        "keeps no images",
    ]
    assert {one.measured for one in untried} == {"there is no name to make another one by"}


def test_a_check_alone_finds_what_it_finds_among_all():
    one = Examination(load(f"{MODULE}:BatchOfOne")).find(CHECKS[-1])
    assert (one.verdict, one.measured) == (Verdict.NOT_TRIED, "first mend 'one shape'")


def test_one_that_looks_back_at_all_there_was_is_not_fed_so_much():
    recognizer = load(f"{MODULE}:Maps")
    recognizer.looks_back = 10**9
    examination = Examination(recognizer)
    for name in ("queries one at a time", "whichever others are there"):
        (one,) = (check for check in CHECKS if check.name == name)
        found = examination.find(one)
        assert (found.verdict, found.measured) == (Verdict.NOT_TRIED, "it looks back 1000000000")


def test_what_a_recognizer_prints_is_kept_from_stdout(capsys):
    examined("Chatty")
    assert capsys.readouterr().out == ""


def test_cost_is_known_where_embeddings_can_be_compared():
    for recognizer, values in (("Sound", 49), ("Maps", 48), ("Edges", 49)):
        cost = Examination(load(f"{MODULE}:{recognizer}")).cost()
        assert cost is not None
        assert (cost.dimension, cost.embedding_bytes) == (values, 4 * values)
        assert cost.embed_ms > 0
    assert Examination(load(f"{MODULE}:Long")).cost() is None


def test_own_memory_is_that_of_a_process_of_its_own():
    name = f"{MODULE}:Hoards"
    kept_mb = 640 * 480 * 3 * 30 / 2**20
    assert Examination(load(name), name).own_mb() == pytest.approx(kept_mb, rel=0.5)
    assert math.isnan(Examination(load(name)).own_mb())


def test_each_check_is_named_once_and_says_what_to_do_in_one_line():
    names = [check.name for check in CHECKS]
    assert len(set(names)) == len(names)
    for check_ in CHECKS:
        assert set(check_.needs) <= set(CHECKS)
        assert 0 < len(check_.remedy) <= 90
        assert "\n" not in check_.remedy
