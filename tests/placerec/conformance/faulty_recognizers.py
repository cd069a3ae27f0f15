# SPDX-License-Identifier: Apache-2.0
"""A recognizer that does everything right, and others with one fault each."""

import os
import sys
import threading
import time

import numpy as np

LIGHT = 48  # of the embedding's values, one per part of the image


class Sound:
    """Recognises a place by which parts of it are light."""

    min_similarity = 0.9

    def embed(self, image):
        parts = [
            part.mean()
            for row in np.array_split(image[::8, ::8].astype(np.float64), 6)
            for part in np.array_split(row, 8, axis=1)
        ]
        return unit(np.append(1e-3, parts - np.mean(parts)))


def unit(vector):
    return (vector / np.linalg.norm(vector)).astype(np.float32)


def signed(embedding, seed):
    """Return an embedding that is near only those made with the same seed."""
    return embedding * np.random.default_rng(seed).choice(np.float32([-1, 1]), embedding.size)


class Raises(Sound):
    def embed(self, image):
        raise OSError("no\nweights")


class ReturnsNothing(Sound):
    def embed(self, image):
        self.last = super().embed(image)


class ReturnsText(Sound):
    def embed(self, image):
        return "a desk"


class ReturnsNoValues(Sound):
    def embed(self, image):
        return np.empty(0, np.float32)


class Degrees(Sound):
    min_similarity = 25.0


class NoThreshold(Sound):
    min_similarity = None


class BatchOfOne(Sound):
    def embed(self, image):
        return super().embed(image)[None]


class SizeOfContent(Sound):
    def embed(self, image):
        return unit(np.ones(4 + int(image.mean()) % 5))


class Double(Sound):
    def embed(self, image):
        return super().embed(image).astype(np.float64)


class ReturnsList(Sound):
    def embed(self, image):
        return super().embed(image).tolist()


class NotANumber(Sound):
    def embed(self, image):
        embedding = super().embed(image)
        embedding[3] = np.nan
        return embedding


class Long(Sound):
    def embed(self, image):
        return super().embed(image) * np.float32(2)


class NeedsColour(Sound):
    def embed(self, image):
        if not (image[::9, ::9, 0] != image[::9, ::9, 1]).any():
            raise ZeroDivisionError("no saturation")
        return super().embed(image)


class NeedsLight(Sound):
    def embed(self, image):
        return super().embed(image) * np.float32(image.max() > 0)


class NeedsVga(Sound):
    def embed(self, image):
        return super().embed(image.reshape(480, 640, 3))


class SizeOfImage(Sound):
    def embed(self, image):
        return unit(np.append(super().embed(image), np.zeros(len(image))))


class Scribbles(Sound):
    def embed(self, image):
        embedding = super().embed(image)
        image[0] = 7
        return embedding


class Chatty(Sound):
    def embed(self, image):
        sys.stdout.write(f"embedding {image.shape}\n")
        return super().embed(image)


class Moody(Sound):
    def __init__(self):
        self.rng = np.random.default_rng(0)

    def embed(self, image):
        return unit(super().embed(image) + self.rng.normal(0, 1e-6, LIGHT + 1))


class Remembers(Sound):
    """Mixes in a little of the last image, if that was another one."""

    last = None

    def embed(self, image):
        last, self.last = self.last, image
        other = image if last is None else last
        return unit(super().embed(image) + 0.01 * super().embed(other))


class TiedToItsThread(Sound):
    def __init__(self):
        self.mine = threading.local()
        self.mine.ready = True

    def embed(self, image):
        if not hasattr(self.mine, "ready"):
            raise RuntimeError("made in another thread")
        return super().embed(image)


class SharedBuffer(Sound):
    def embed(self, image):
        self.buffer = image
        time.sleep(0.001)  # long enough for another thread, however busy the machine is
        return super().embed(self.buffer)


class OtherEveryTime(Sound):
    def __init__(self):
        self.seed = time.perf_counter_ns()

    def embed(self, image):
        return signed(super().embed(image), self.seed)


class OtherEveryRun(Sound):
    def embed(self, image):
        return signed(super().embed(image), abs(hash("light")))


class OnlyHere(Sound):
    home = os.getpid()

    def __init__(self):
        if "PYTHONHASHSEED" in os.environ:
            raise OSError("no camera")


class TurnedRound(Sound):
    def embed_many(self, images):
        return [self.embed(image) for image in images[::-1]]


class LeavesOut(Sound):
    def embed_many(self, images):
        return [self.embed(image) for image in images[1:]]


class Hoards(Sound):
    def __init__(self):
        self.seen = []

    def embed(self, image):
        self.seen.append(image)
        return super().embed(image)


class Blind(Sound):
    def embed(self, image):
        return np.float32([0.6, 0.8])


class Glares(Sound):
    """Takes the brightest value that there is for part of the place."""

    def embed(self, image):
        return signed(super().embed(image), int(image.max()) // 8)


class Edges(Sound):
    """Takes exactly where the first board begins for part of the place."""

    def embed(self, image):
        steps = np.abs(np.diff(np.log1p(image.astype(np.float64)).mean(axis=(0, 2))))
        return signed(super().embed(image), int(steps.argmax()))


class Maps(Sound):
    """Compares maps by how far apart they are, and returns no vector."""

    min_similarity = 0.75
    looks_back = 0

    def embed(self, image):
        return 5 * super().embed(image)[1:].reshape(6, 8)

    def compare(self, queries, references):
        return 1 - np.abs(queries[:, None] - references).mean(axis=(2, 3))


class Transposes(Maps):
    def compare(self, queries, references):
        return super().compare(references, queries)


class Distances(Maps):
    def compare(self, queries, references):
        return 10 * super().compare(queries, references)


class NoNumbers(Maps):
    def compare(self, queries, references):
        return None


class DividesByZero(Maps):
    def compare(self, queries, references):
        raise ZeroDivisionError("no words")


class Centres(Maps):
    """Takes the mean of what it is given out of it, where it lies."""

    def compare(self, queries, references):
        middle = references.mean(axis=0)
        references -= middle
        return super().compare(queries - middle, references)


class CompareIsNoMethod(Sound):
    compare = True


class LooksAhead(Maps):
    looks_back = -1


class LooksFurtherBack(Maps):
    def compare(self, queries, references):
        similarities = super().compare(queries, references)
        before = np.concatenate([similarities[:1], similarities[:-1]])
        return 0.9 * similarities + 0.1 * before


class UnlikeItself(Maps):
    def compare(self, queries, references):
        return super().compare(queries, references)[:, ::-1]
