# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.errors import RecognizerError
from placerec.recognizers.learned import TRIPLET_WEIGHTS, LearnedRecognizer, Triplet


@pytest.fixture(scope="module")
def triplet():
    return Triplet()


def test_it_is_the_defaults_twin_with_other_values(triplet):
    default = LearnedRecognizer()
    ours, others = (each.network.state_dict() for each in (triplet, default))
    assert {name: value.shape for name, value in ours.items()} == {
        name: value.shape for name, value in others.items()
    }
    assert triplet.network.preprocessing == default.network.preprocessing
    assert triplet.trained_on == default.trained_on
    assert triplet.fingerprint != default.fingerprint
    image = np.random.default_rng(0).integers(0, 256, (60, 80, 3), np.uint8)
    assert not np.allclose(triplet.embed(image), default.embed(image), atol=0.01)


def test_it_says_what_it_runs_on_and_was_calibrated_on(triplet):
    assert triplet.weights.endswith("trained as the default but with the triplet loss")
    assert triplet.certificate and triplet.certificate.min_similarity == triplet.min_similarity


def test_where_it_is_not_installed_it_says_how_to_make_it(tmp_path):
    with pytest.raises(RecognizerError, match="--loss triplet --ship") as error:
        Triplet(tmp_path / TRIPLET_WEIGHTS.name)
    assert "\n" not in str(error.value)
