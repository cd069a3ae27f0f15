# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest

from placerec.conformance import check
from placerec.gradients import GradientRecognizer


class Good(GradientRecognizer):
    pass


class Batched(Good):
    def embed(self, image):
        return super().embed(image)[None]


class Rows(Good):
    """Compares (2, 248) embeddings itself, by their mean difference."""

    def embed(self, image):
        return super().embed(image).reshape(2, -1) * 5

    def compare(self, queries, references):
        return 1 - abs(queries[:, None] - references[None]).mean(axis=(2, 3))


class Double(Good):
    def embed(self, image):
        return super().embed(image).astype(np.float64)


class BlackIsNan(Good):
    def embed(self, image):
        return super().embed(image) * (np.nan if image.max() == 0 else 1)


class Long(Good):
    def embed(self, image):
        return super().embed(image) * 2


class SizeOfImage(Good):
    def embed(self, image):
        return np.float32(np.ones(len(image)) / np.sqrt(len(image)))


class Moody(Good):
    def __init__(self):
        self.rng = np.random.default_rng(0)

    def embed(self, image):
        noisy = super().embed(image) + self.rng.normal(0, 1e-6, 496).astype(np.float32)
        return noisy / np.linalg.norm(noisy)


class Scribbles(Good):
    def embed(self, image):
        answer = super().embed(image)
        image[0] = 7
        return answer


class Same(Good):
    def embed(self, image):
        return np.float32([0.6, 0.8])


class Pixels(Good):
    """Any change of the first column makes it another place."""

    def embed(self, image):
        values = np.float32(np.random.default_rng(int(image[:, 0].sum())).normal(size=64))
        return values / np.linalg.norm(values)


class NoCosine(Good):
    min_similarity = 90.0


@pytest.mark.parametrize(
    ("recognizer", "failed"),
    [
        (Batched, "shape (D,)"),
        (Double, "dtype float32"),
        (BlackIsNan, "finite"),
        (Long, "unit length"),
        (SizeOfImage, "one size for all images"),
        (Moody, "same image, same embedding"),
        (Scribbles, "leaves the image alone"),
        (Same, "finds an image itself first"),
        (Pixels, "finds it when dimmed"),
        (Pixels, "finds it when shifted"),
        (NoCosine, "min_similarity is a cosine"),
    ],
)
def test_each_fault_is_found(recognizer, failed):
    report = check(recognizer())
    assert failed in [one.name for one in report.checks if not one.passed]
    assert not report.passed


def test_what_compares_its_embeddings_itself_conforms_with_any_shape():
    report = check(Rows())
    assert [one.name for one in report.checks if not one.passed] == []


def test_a_raising_recognizer_fails_every_check_that_calls_it():
    class Raises(Good):
        def embed(self, image):
            raise RuntimeError("boom")

    report = check(Raises())
    assert [one.passed for one in report.checks].count(True) == 1
    assert "RuntimeError: boom" in report.checks[-1].detail
