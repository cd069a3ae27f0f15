# SPDX-License-Identifier: Apache-2.0
import sys
from pathlib import Path

import pytest

from placerec.conformance import CHECKS, Examination, Verdict, check
from placerec.recognizer import load

HERE = Path(__file__).parent
MODULE = "faulty_recognizers"

FAULTS = {
    "Raises": "returns numbers",
    "ReturnsNothing": "returns numbers",
    "ReturnsText": "returns numbers",
    "ReturnsNoValues": "returns numbers",
    "Degrees": "min_similarity is a cosine",
    "NoThreshold": "min_similarity is a cosine",
    "BatchOfOne": "shape (D,)",
    "SizeOfContent": "shape (D,)",
    "Double": "float32",
    "ReturnsList": "float32",
    "NotANumber": "finite",
    "Long": "unit length",
    "NeedsColour": "grey and empty images",
    "NeedsLight": "grey and empty images",
    "NeedsVga": "images of any size",
    "SizeOfImage": "images of any size",
    "Scribbles": "leaves the image alone",
    "Chatty": "prints nothing",
    "Moody": "the same image again",
    "Remembers": "whatever came before",
    "TiedToItsThread": "in another thread",
    "SharedBuffer": "in several threads at once",
    "OtherEveryTime": "by a second instance",
    "OtherEveryRun": "in a fresh process",
    "OnlyHere": "in a fresh process",
    "Hoards": "keeps no images",
    "Blind": "an image itself",
    "Glares": "darker and brighter",
    "Pixels": "shifted by 16 pixels",
}


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.syspath_prepend(HERE)


def examined(class_name):
    name = f"{MODULE}:{class_name}"
    return check(load(name), name)


def failed(report):
    return [finding.check.name for finding in report.findings if finding.failed]


def test_a_sound_recognizer_passes_every_check():
    report = examined("Sound")
    assert [finding.verdict for finding in report.findings] == [Verdict.PASSED] * len(CHECKS)
    assert report.passed


@pytest.mark.parametrize("recognizer", ["gradients", "learned"])
def test_what_is_built_in_passes_every_check(recognizer):
    report = check(load(recognizer), recognizer)
    assert report.passed, str(report)
    assert {finding.verdict for finding in report.findings} == {Verdict.PASSED}


@pytest.mark.parametrize(("recognizer", "caught_by"), FAULTS.items())
def test_a_fault_is_caught_by_the_check_meant_for_it_and_no_other(recognizer, caught_by):
    report = examined(recognizer)
    assert failed(report) == [caught_by], str(report)
    assert not report.passed


def test_there_is_no_check_that_cannot_fail():
    assert set(FAULTS.values()) == {check.name for check in CHECKS}
