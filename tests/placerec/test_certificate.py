# SPDX-License-Identifier: Apache-2.0
import json
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from placerec.certificate import (
    Certificate,
    certificate_of,
    certificate_path,
    fingerprint,
    read_certificate,
    write_certificate,
)
from placerec.errors import LoopcloseError, RecognizerError
from placerec.recognizers.gradients import GradientRecognizer


def test_reads_what_it_wrote(tmp_path, certificate):
    path = tmp_path / "default.json"
    write_certificate(certificate, path)
    assert read_certificate(path) == certificate
    assert json.loads(path.read_text())["kinds"][0]["threshold"] == 0.8


def test_a_match_is_worth_verifying_from_where_hardly_any_are_of_different_places(certificate):
    assert certificate.min_similarity == 0.6
    assert certificate.calibrated_range == (-0.1, 0.9)
    # Cosines of single precision may end a little above 1, which no recognizer may ask for.
    assert with_kinds(certificate, {"different_places": (0.0, 1.0000001)}).min_similarity == 1.0


def with_kinds(certificate, *changes):
    """Return the certificate with a kind of scene for each of some changes to its own."""
    (kind,) = certificate.kinds
    kinds = tuple(kind.model_copy(update=change) for change in changes)
    return certificate.model_copy(update={"kinds": kinds})


def test_of_several_kinds_what_is_alike_in_one_is_verified_and_in_all_is_believed(certificate):
    other = {"data": "a hall", "pairs": 5, "different_places": (-0.3, 0.7), "threshold": 0.75}
    both = with_kinds(certificate, {}, other)
    assert (both.min_similarity, both.threshold) == (0.6, 0.8)
    assert (both.different_places, both.same_place) == ((-0.3, 0.7), (0.3, 0.9))
    assert both.calibrated_range == (-0.3, 0.9)
    assert (both.data, both.pairs) == ("somewhere, a hall", 50)


def test_similarities_like_those_calibrated_on_need_no_warning(certificate):
    usual = np.linspace(-0.1, 0.9, 100)
    assert certificate.outside_calibrated_range(usual) is None
    assert certificate.outside_calibrated_range(np.append(usual, np.full(11, 0.95))) is None
    assert certificate.outside_calibrated_range(np.append(usual, np.full(12, 0.95))) is not None


@pytest.mark.parametrize("same_place_share", [0.0, 0.5, 0.9])
def test_how_often_places_come_back_is_no_reason_to_warn(certificate, same_place_share):
    rng = np.random.default_rng(0)
    same = rng.uniform(0.3, 0.9, int(1000 * same_place_share))
    different = rng.uniform(-0.1, 0.6, 1000 - len(same))
    assert certificate.outside_calibrated_range(np.concatenate([same, different])) is None


@pytest.mark.parametrize("outside", [0.95, -0.2])
def test_many_similarities_outside_are_one_sentence(certificate, outside):
    live = np.array([0.5] * 80 + [outside] * 20, np.float32)
    warning = certificate.outside_calibrated_range(live)
    assert warning.startswith("20% of the 100 similarities lie outside -0.100 to 0.900")
    assert "calibrated on somewhere" in warning
    assert "\n" not in warning


def test_a_threshold_that_nearly_all_reach_sorts_nothing_out(certificate):
    alike = np.array([0.7] * 96 + [0.5] * 4, np.float32)
    warning = certificate.outside_calibrated_range(alike)
    assert warning.startswith("96% of the 100 similarities reach 0.600, as 1% did between differ")
    assert "\n" not in warning
    assert certificate.outside_calibrated_range(np.append(alike, [0.5, 0.5])) is None


def test_too_few_similarities_say_nothing(certificate):
    assert certificate.outside_calibrated_range(np.full(49, -0.9)) is None
    assert certificate.outside_calibrated_range(np.full(50, -0.9)) is not None
    assert certificate.outside_calibrated_range(np.empty(0)) is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"threshold_interval": [0.7, 1.5]}, r"\(threshold_interval\.1: Input should be less than"),
        ({"recall": -0.1}, r"\(recall: "),
        ({"curve": [[0.9, 1.0]]}, r"\(curve\.0\."),
        ({"extra": 1}, r"\(extra: "),
        ({"kinds": []}, r"\(kinds: "),
    ],
)
def test_changed_file_is_refused_in_one_line(tmp_path, certificate, change, message):
    path = tmp_path / "changed.json"
    path.write_text(json.dumps(certificate.model_dump(mode="json") | change))
    with pytest.raises(RecognizerError, match=message) as caught:
        read_certificate(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("version", [{}, {"version": 1}, {"version": 3}])
def test_certificate_of_before_says_how_to_make_it_anew(tmp_path, certificate, version):
    path = tmp_path / "before.json"
    content = certificate.model_dump(mode="json", exclude={"version", "kinds"})
    path.write_text(json.dumps(content | {"threshold": 0.8} | version))
    with pytest.raises(RecognizerError, match=r"another version .*`placerec calibrate`") as caught:
        read_certificate(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b"[" * 9999])
def test_file_that_is_no_certificate_is_refused(tmp_path, content):
    path = tmp_path / "none.json"
    path.write_bytes(content)
    with pytest.raises(RecognizerError, match=r"^not a calibration certificate"):
        read_certificate(path)


def test_missing_file_is_one_line(tmp_path):
    with pytest.raises(RecognizerError, match="cannot read the certificate: No such file"):
        read_certificate(tmp_path / "gone.json")


def test_folder_that_is_not_there_is_one_line(tmp_path, certificate):
    with pytest.raises(LoopcloseError, match=r"cannot write c\.json: No such file"):
        write_certificate(certificate, tmp_path / "gone" / "c.json")


class Learned:
    min_similarity = 0.5

    def __init__(self, version, certificate=None):
        self.fingerprint = f"sha256:{version}"
        self.certificate = certificate

    def embed(self, image):
        raise NotImplementedError


class Unnamed:
    """A recognizer that does not say which version it is."""

    min_similarity = 0.5

    def embed(self, image):
        return np.ones(1, np.float32)


def test_fingerprint_changes_with_the_weights_or_else_with_the_source():
    assert fingerprint(Learned("a")) == "sha256:a"
    assert fingerprint(Learned("b")) == "sha256:b"
    assert fingerprint(GradientRecognizer()) == GradientRecognizer.fingerprint
    own = fingerprint(Unnamed())
    assert own == f"sha256:{sha256(Path(__file__).read_bytes()).hexdigest()}"


def test_recognizer_without_source_has_no_fingerprint():
    typed_in = type("Typed", (), {"__module__": "builtins"})()
    with pytest.raises(RecognizerError, match="recognizer 'Typed' has no source file"):
        fingerprint(typed_in)


def test_certificate_of_a_recognizer_is_its_own_or_none(certificate):
    assert certificate_of(GradientRecognizer()) is None
    assert certificate_of(Learned("0")) is None
    assert certificate_of(Learned("0", certificate)) is certificate


@pytest.mark.parametrize(
    ("version", "kind", "message"),
    [
        (
            "1",
            Certificate,
            r"has the certificate of another version, sha256:0\.\.\. instead",
        ),
        ("0", Path, "has a certificate that is a PosixPath; it must be what "),
    ],
)
def test_certificate_that_is_not_of_the_recognizer_is_refused(certificate, version, kind, message):
    wrong = certificate if kind is Certificate else Path("c.json")
    with pytest.raises(RecognizerError, match=f"recognizer 'Learned' {message}") as caught:
        certificate_of(Learned(version, wrong))
    assert "\n" not in str(caught.value)


def test_certificate_lies_beside_the_weights():
    assert certificate_path(Path("runs/a.b/w.safetensors")) == Path("runs/a.b/w.certificate.json")
