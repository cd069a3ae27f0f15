# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from placerec.conformance import check
from placerec.errors import RecognizerError
from placerec.recognizers.feature_maps import find_maps
from placerec.recognizers.fitted_file import read_fitted, shipped, write_fitted
from placerec.recognizers.untrained import LAYER, UntrainedLayer


@pytest.fixture
def recognizer(weights, photographs, tmp_path):
    path = tmp_path / "mean.safetensors"
    fitted = replace(UntrainedLayer.fit(photographs[:10]), trained_on=("boards",))
    write_fitted(path, "untrained", fitted)
    return UntrainedLayer(path)


def test_it_is_the_flattened_layer_without_the_mean_of_other_images(recognizer, photographs):
    maps = find_maps([LAYER])
    rows = np.array([maps(image).ravel() for image in photographs[:11]], np.float64)
    expected = rows[10] - rows[:10].mean(axis=0)
    found = recognizer.embed(photographs[10])
    assert found.shape == (320 * 5 * 6,)
    # The mean is kept in half precision.
    np.testing.assert_allclose(found, expected / np.linalg.norm(expected), atol=2e-4)


def test_it_conforms_but_for_the_threshold_that_is_not_calibrated(recognizer):
    failed = {one.check.name for one in check(recognizer).findings if one.failed}
    assert failed <= {"min_similarity keeps others out"}


def test_it_says_what_it_runs_on(recognizer):
    assert recognizer.weights == (
        "mobilenet_v2 block16 at 192x144 px, published weights mobilenet_v2_1.0.npz; mean of boards"
    )
    assert recognizer.trained_on == ("boards",)


def test_without_weights_it_says_what_to_do(recognizer, monkeypatch):
    monkeypatch.delenv("LOOPCLOSE_WEIGHTS")
    with pytest.raises(RecognizerError, match="LOOPCLOSE_WEIGHTS"):
        UntrainedLayer()


def test_what_comes_with_the_package_is_of_other_weights_than_these(weights):
    with pytest.raises(RecognizerError, match="placerec fit untrained FOLDER"):
        UntrainedLayer()


def test_what_comes_with_the_package_fits_the_layer(machine):
    assert read_fitted(shipped("untrained"), "untrained").arrays["mean"].shape == (320, 5, 6)
