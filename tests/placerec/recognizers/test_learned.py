# SPDX-License-Identifier: Apache-2.0
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch

from placerec.certificate import certificate_of, fingerprint, write_certificate
from placerec.conformance import check
from placerec.errors import LoopcloseError, RecognizerError
from placerec.networks import TRUNKS, PlaceNetwork
from placerec.networks.weights_file import save_weights
from placerec.networks.whitening import merge, whiten
from placerec.recognizer import load
from placerec.recognizers import learned
from placerec.recognizers.learned import LearnedRecognizer, keep_calibration


def _image(seed, height=60, width=80):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), np.uint8)


@pytest.fixture(scope="module")
def recognizer(tmp_path_factory):
    path = tmp_path_factory.mktemp("weights") / "w.safetensors"
    network = PlaceNetwork(TRUNKS["mobilenet_v2"], 32, block="block3", size_px=(96, 72))
    with torch.no_grad():
        # Blocks of colour at several scales, so that the layer sees more than noise.
        coarse = [np.kron(_image(i, 6, 8), np.ones((10, 10, 1), np.uint8)) for i in range(40)]
        maps = network.features(network.prepare(coarse))
        whiten(network, network.flatten(maps))
        merge(network)
    save_weights(network, path, 0.4)
    return LearnedRecognizer(path)


def test_conforms(recognizer):
    report = check(recognizer)
    assert report.passed, str(report)


def test_threshold_comes_with_the_weights(recognizer):
    assert recognizer.min_similarity == 0.4


def test_it_says_which_weights_it_runs_on(recognizer):
    assert recognizer.weights == (
        "mobilenet_v2 block3 at 96x72 px, trained for places: w.safetensors"
    )
    assert recognizer.trained_on == ()
    default = LearnedRecognizer()
    assert default.weights.endswith("trained for places: those of the package")
    assert default.trained_on == ("ie_tower:train",)


def test_images_of_any_kind(recognizer):
    grey = _image(1)[..., 0]
    expected = recognizer.embed(np.repeat(grey[..., None], 3, axis=2))
    np.testing.assert_array_equal(recognizer.embed(grey), expected)
    alpha = np.dstack([grey, grey, grey, np.zeros_like(grey)])
    np.testing.assert_array_equal(recognizer.embed(alpha), expected)
    for shape in ((1, 1), (7, 500), (481, 3)):
        assert np.linalg.norm(recognizer.embed(_image(1, *shape))) == pytest.approx(1.0, abs=1e-5)
    with pytest.raises(RecognizerError, match="uint8"):
        recognizer.embed(np.zeros((4, 4, 3)))


def test_frames_in_one_pass_are_as_frames_one_by_one(recognizer):
    images = [_image(seed, 50 + seed) for seed in range(40)]  # more than go in one pass
    one_by_one = np.array([recognizer.embed(image) for image in images])
    np.testing.assert_allclose(recognizer.embed_many(images), one_by_one, atol=1e-5)
    assert recognizer.embed_many([]).shape == (0, 32)


def test_place_is_the_centre_of_its_frames(recognizer):
    images = [_image(seed) for seed in range(3)]
    centre = recognizer.embed_many(images).mean(axis=0)
    place = recognizer.embed_place(images)
    np.testing.assert_allclose(place, centre / np.linalg.norm(centre), atol=1e-6)
    assert place.dtype == np.float32
    np.testing.assert_allclose(
        recognizer.embed_place(images[:1]), recognizer.embed(images[0]), atol=1e-5
    )
    with pytest.raises(RecognizerError, match="at least 1 frame"):
        recognizer.embed_place([])


def test_threads_get_the_same_answers_and_the_callers_settings_stay(recognizer):
    images = [_image(seed) for seed in range(8)] * 4
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        expected = [recognizer.embed(image) for image in images]
        assert torch.get_num_threads() == 2
    finally:
        torch.set_num_threads(before)
    with ThreadPoolExecutor(4) as pool:
        for one, other in zip(pool.map(recognizer.embed, images), expected, strict=True):
            np.testing.assert_array_equal(one, other)


def test_missing_weights_are_one_line(tmp_path):
    with pytest.raises(RecognizerError, match="cannot read the weights"):
        LearnedRecognizer(tmp_path / "none.safetensors")


def test_default_that_is_not_installed_is_one_line_that_says_what_to_do(tmp_path, monkeypatch):
    path = tmp_path / "default.safetensors"
    monkeypatch.setattr(learned, "DEFAULT_WEIGHTS", path)
    monkeypatch.setattr(LearnedRecognizer.__init__, "__defaults__", (path, TRUNKS.values()))
    with pytest.raises(RecognizerError) as caught:
        load("placerec.recognizers.learned:LearnedRecognizer")
    message = str(caught.value)
    assert "no trained weights are installed; name a file made by `placerec train`" in message
    assert message.endswith(str(path))
    assert "\n" not in message


@pytest.fixture
def certify(certificate):
    """Return a function that makes a certificate for a recognizer."""
    (kind,) = certificate.kinds
    kinds = (kind.model_copy(update={"different_places": (-0.1, 0.625)}),)
    return lambda recognizer, **changes: certificate.model_copy(
        update={"fingerprint": recognizer.fingerprint, "kinds": kinds} | changes
    )


def test_calibrated_weights_carry_their_threshold_and_find_their_certificate(
    recognizer, tmp_path, certify
):
    weights = tmp_path / "w.safetensors"
    save_weights(recognizer.network, weights, 0.25)
    before = LearnedRecognizer(weights)
    assert before.certificate is None
    path = keep_calibration(weights, certify(before))
    assert path == tmp_path / "w.certificate.json"
    after = LearnedRecognizer(weights)
    assert after.min_similarity == 0.625
    assert after.fingerprint == before.fingerprint
    assert certificate_of(after) == certify(before)
    np.testing.assert_array_equal(after.embed(_image(1)), before.embed(_image(1)))


def test_certificate_of_other_weights_is_refused_but_they_can_be_calibrated(
    recognizer, tmp_path, certify
):
    weights = tmp_path / "w.safetensors"
    save_weights(recognizer.network, weights, 0.25)
    path = tmp_path / "w.certificate.json"
    write_certificate(certify(recognizer, fingerprint="sha256:other"), path)
    trained_again = LearnedRecognizer(weights)
    assert trained_again.embed(_image(1)).shape == (32,)
    with pytest.raises(RecognizerError) as caught:
        certificate_of(trained_again)
    assert str(caught.value) == (
        "the certificate is of other weights than w.safetensors; calibrate these with "
        f"`placerec calibrate`, or remove it: {path}"
    )
    keep_calibration(weights, certify(trained_again))
    assert certificate_of(LearnedRecognizer(weights)) is not None


def test_certificate_that_cannot_be_written_leaves_the_weights_alone(recognizer, tmp_path, certify):
    weights = tmp_path / "w.safetensors"
    save_weights(recognizer.network, weights, 0.25)
    (tmp_path / "w.certificate.json").mkdir()
    with pytest.raises(LoopcloseError, match=r"cannot write w\.certificate\.json"):
        keep_calibration(weights, certify(recognizer))
    assert LearnedRecognizer(weights).min_similarity == 0.25


def test_fingerprint_is_of_the_weights_and_how_they_are_fed_not_of_the_threshold(tmp_path):
    def saved(min_similarity=0.4, seed=0, size_px=(48, 36), change=0.0):
        network = PlaceNetwork(
            TRUNKS["mobilenet_v2"], 4, block="stem", grid=(2, 2), size_px=size_px, seed=seed
        )
        with torch.no_grad():
            network.fully_connected.weight[3, 5] += change
        path = tmp_path / "w.safetensors"
        save_weights(network, path, min_similarity)
        return fingerprint(LearnedRecognizer(path))

    expected = saved()
    assert expected.startswith("sha256:")
    assert saved(min_similarity=0.9) == expected
    others = [saved(seed=1), saved(change=0.25), saved(size_px=(64, 48))]
    assert len({expected, *others}) == 4


def test_is_loaded_by_the_path_of_its_weights(recognizer, tmp_path):
    path = tmp_path / "mine.safetensors"
    save_weights(recognizer.network, path, 0.25)
    loaded = load(str(path))
    assert isinstance(loaded, LearnedRecognizer)
    assert loaded.min_similarity == 0.25
    np.testing.assert_array_equal(loaded.embed(_image(1)), recognizer.embed(_image(1)))


@pytest.mark.parametrize("content", [None, b"", b"not weights"])
def test_path_of_bad_weights_is_one_line(tmp_path, content):
    path = tmp_path / "w.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(RecognizerError, match=r"^(cannot|the weights are not).*w\.safetensors$"):
        load(str(path))
