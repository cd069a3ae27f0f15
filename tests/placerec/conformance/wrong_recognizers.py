# SPDX-License-Identifier: Apache-2.0
"""What goes wrong in recognizers that people write: a good one, with one mistake each."""

import os

import cv2
import numpy as np
import torch

from placerec.recognizers.gradients import GradientRecognizer

RNG_SEED = 0
STALE_AFTER = 200


def unit(vector):
    return (vector / np.linalg.norm(vector)).astype(np.float32)


class Layout:
    """Where it is lighter or darker than on average; cosines are of both signs."""

    min_similarity = 0.9

    def embed(self, image):
        small = cv2.resize(image, (16, 12), interpolation=cv2.INTER_AREA).astype(np.float64)
        return unit(np.append(1e-3, (small - small.mean()).ravel()))


class Softmax(GradientRecognizer):
    def compare(self, queries, references):
        weights = np.exp(20 * (queries @ references.T))
        return weights / weights.sum(axis=1, keepdims=True)


class SharesOfTheBest(Layout):
    """Divided by the largest there is: the best always has 1."""

    looks_back = 0

    def compare(self, queries, references):
        cosines = queries @ references.T
        return cosines / np.abs(cosines).max(axis=1, keepdims=True)


class Collapsed(GradientRecognizer):
    min_similarity = 0.9999

    def embed(self, image):
        return unit(np.append(100.0, super().embed(image)))


class Unreachable(Layout):
    """Views of a place have 0.95 and more."""

    min_similarity = 0.9999999


class PassesAll(GradientRecognizer):
    min_similarity = 0.2


class SeedsNumpy(Layout):
    def embed(self, image):
        np.random.seed(RNG_SEED)  # noqa: NPY002
        return super().embed(image)


class SeedsTorch(Layout):
    def embed(self, image):
        torch.manual_seed(RNG_SEED)
        return super().embed(image)


class Stale(Layout):
    """A cache that is full answers with what is in it."""

    def __init__(self):
        self.cache = {}

    def embed(self, image):
        key = image.tobytes()
        if key not in self.cache and len(self.cache) >= STALE_AFTER:
            return next(reversed(self.cache.values())).copy()
        return self.cache.setdefault(key, super().embed(image)).copy()


class Stuck(Layout):
    """Answers with the last it found, once it has seen so many."""

    count = 0

    def embed(self, image):
        self.count += 1
        if self.count <= STALE_AFTER:
            self.last = super().embed(image)
        return self.last.copy()


class Ring(Layout):
    """Returns rows of a buffer that comes round."""

    def __init__(self):
        self.rows, self.count = np.empty((STALE_AFTER, 577), np.float32), 0

    def embed(self, image):
        row = self.rows[self.count % len(self.rows)]
        self.count += 1
        row[:] = super().embed(image)
        return row


class OneCorner(Layout):
    def embed(self, image):
        return super().embed(image[: image.shape[0] // 2, : image.shape[1] // 2])


class AbsoluteCosine(GradientRecognizer):
    def compare(self, queries, references):
        return np.abs(np.clip(queries @ references.T, -1, 1))


class ZeroInTheDark(Layout):
    def embed(self, image):
        small = cv2.resize(image, (16, 12), interpolation=cv2.INTER_AREA).astype(np.float64)
        vector = (small - small.mean()).ravel().astype(np.float32)
        return vector / max(np.linalg.norm(vector), np.float32(1e-12))


class ExpectsFractions(Layout):
    """Expects pixels from 0 to 1, so that nearly all are 1."""

    def embed(self, image):
        return super().embed(np.uint8(255) * (image > 0).astype(np.uint8))


class DarkIsNaN(Layout):
    def embed(self, image):
        small = cv2.resize(image, (16, 12), interpolation=cv2.INTER_AREA).astype(np.float32)
        with np.errstate(invalid="ignore"):
            values = (small - small.mean()) / small.std()
        return unit(np.append(1.0, values))


class HalfPrecision(Layout):
    """Squares of pixels are beyond what float16 can hold."""

    def embed(self, image):
        small = cv2.resize(image, (16, 12), interpolation=cv2.INTER_AREA).astype(np.float16)
        with np.errstate(over="ignore", invalid="ignore"):
            return (small / np.sqrt((small**2).sum(dtype=np.float16))).ravel().astype(np.float32)


class InPlace(Layout):
    def embed(self, image):
        image[:] = cv2.GaussianBlur(image, (5, 5), 0)
        return super().embed(image)


class OneBuffer(Layout):
    def __init__(self):
        self.answer = np.empty(577, np.float32)

    def embed(self, image):
        self.answer[:] = super().embed(image)
        return self.answer


class RunningMean(Layout):
    mean = 0.0

    def embed(self, image):
        embedding = super().embed(image)
        self.mean = 0.99 * self.mean + 0.01 * embedding
        return unit(embedding - self.mean)


class Dropout(Layout):
    def embed(self, image):
        answer = super().embed(image)
        kept = np.random.default_rng().random(answer.size) < 0.9
        kept[0] = True  # all that there is of an empty image: nothing else is wrong with this one
        return unit(answer * kept)


class FixedSize(Layout):
    """Looks for its layout in pixels of the image that it was written for."""

    def embed(self, image):
        return super().embed(np.pad(image, ((0, 480), (0, 640), (0, 0)))[:480, :640])


class NeedsRowsInOrder(Layout):
    def embed(self, image):
        return super().embed(torch.from_numpy(image).numpy())


class ChangesFolder(Layout):
    def embed(self, image):
        os.chdir("/")
        return super().embed(image)


class SilencesNumpy(Layout):
    def embed(self, image):
        np.seterr(all="ignore")
        return super().embed(image)


class IndexesOnce(Layout):
    """Makes an index of the references when it is asked first, or of another number of them."""

    looks_back, references = 0, None

    def compare(self, queries, references):
        if self.references is None or len(self.references) != len(references):
            self.references = references.copy()
        return np.clip(queries @ self.references.T, -1, 1)


class Squeezes(Layout):
    looks_back = 0

    def compare(self, queries, references):
        return np.clip((queries[:, None] @ references.T).squeeze(), -1, 1)


class DividesByLength(Layout):
    """Embeds without a length of 1, and divides by it when it compares."""

    looks_back = 0

    def embed(self, image):
        return super().embed(image) * np.float32(image.any())

    def compare(self, queries, references):
        def lengths(rows):
            return np.linalg.norm(rows, axis=1)

        with np.errstate(invalid="ignore"):
            return queries @ references.T / np.outer(lengths(queries), lengths(references))


class Smooths(Layout):
    """Takes the mean with the query before, and does not say that it looks back."""

    looks_back = 0

    def compare(self, queries, references):
        cosines = np.clip(queries @ references.T, -1, 1)
        return 0.5 * cosines + 0.5 * np.concatenate([cosines[:1], cosines[:-1]])


class ReturnsDistances(Layout):
    looks_back = 0

    def compare(self, queries, references):
        return np.clip(1 - queries @ references.T, 0, 1)
