# SPDX-License-Identifier: Apache-2.0
import json

import numpy as np
import pytest

from placerec.certificate import Certificate, read_certificate, write_certificate
from placerec.recognizer import RecognizerError


@pytest.fixture
def certificate():
    return Certificate(
        recognizer="gradients",
        fingerprint="sha256:0",
        data="somewhere",
        images=10,
        skipped=1,
        pairs=45,
        same_place_pairs=9,
        threshold=0.8,
        highest_wrong=0.75,
        recall=0.5,
        threshold_interval=(0.7, 0.85),
        recall_interval=(0.25, 0.75),
        resampled="places",
        resamples=100,
        without_threshold=2,
        seed=0,
        similarity_range=(-0.1, 0.9),
        curve=((0.9, 1.0, 0.1), (0.8, 1.0, 0.5), (0.2, 0.5, 1.0)),
    )


def test_reads_what_it_wrote(tmp_path, certificate):
    path = tmp_path / "default.json"
    write_certificate(certificate, path)
    assert read_certificate(path) == certificate
    assert json.loads(path.read_text())["threshold"] == 0.8


def test_similarities_like_those_calibrated_on_need_no_warning(certificate):
    usual = np.linspace(-0.1, 0.9, 100)
    assert certificate.outside_calibrated_range(usual) is None
    few_outside = np.append(usual, np.full(11, 0.95))
    assert certificate.outside_calibrated_range(few_outside) is None
    assert certificate.outside_calibrated_range(np.empty(0)) is None


@pytest.mark.parametrize("outside", [0.95, -0.2])
def test_many_similarities_outside_are_one_sentence(certificate, outside):
    live = np.array([0.5] * 8 + [outside] * 2, np.float32)
    warning = certificate.outside_calibrated_range(live)
    assert warning.startswith("20% of 10 similarities lie outside -0.100 to 0.900, where 98% lay")
    assert "somewhere" in warning
    assert "\n" not in warning


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"threshold": 1.5}, r"\(threshold: Input should be less than"),
        ({"recall": -0.1}, r"\(recall: "),
        ({"curve": [[0.9, 1.0]]}, r"\(curve\.0\."),
        ({"extra": 1}, r"\(extra: "),
        ({"threshold": None}, r"\(threshold: "),
    ],
)
def test_changed_file_is_refused_in_one_line(tmp_path, certificate, change, message):
    path = tmp_path / "changed.json"
    path.write_text(json.dumps(certificate.model_dump(mode="json") | change))
    with pytest.raises(RecognizerError, match=message) as caught:
        read_certificate(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"\xff"])
def test_file_that_is_no_certificate_is_refused(tmp_path, content):
    path = tmp_path / "none.json"
    path.write_bytes(content)
    with pytest.raises(RecognizerError, match=r"^not a calibration certificate"):
        read_certificate(path)


def test_missing_file_is_one_line(tmp_path):
    with pytest.raises(RecognizerError, match="cannot read the certificate: No such file"):
        read_certificate(tmp_path / "gone.json")


def test_folder_that_is_not_there_is_one_line(tmp_path, certificate):
    with pytest.raises(RecognizerError, match=r"cannot write c\.json: No such file"):
        write_certificate(certificate, tmp_path / "gone" / "c.json")
