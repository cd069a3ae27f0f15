# SPDX-License-Identifier: Apache-2.0
"""Whether a recognizer keeps to the protocol, tried out on generated pictures."""

import time
from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from placerec.index import PlaceIndex
from placerec.recognizer import CheckedRecognizer, PlaceRecognizer

Image = NDArray[np.uint8]
Outcome = tuple[bool, str]

SCENES = 6
HEIGHT_PX, WIDTH_PX = 480, 640
SHIFT_PX = 16
DIMMING = 0.8


@dataclass(frozen=True)
class Check:
    """One thing a recognizer must do, whether it does, and what was seen."""

    name: str
    passed: bool
    detail: str


@dataclass(frozen=True)
class Report:
    """What a recognizer does right and wrong."""

    checks: tuple[Check, ...]

    @property
    def passed(self) -> bool:
        """Whether the recognizer conforms in every point."""
        return all(check.passed for check in self.checks)


def check(recognizer: PlaceRecognizer) -> Report:
    """Try a recognizer on generated pictures; one that raises fails that check only."""
    scenes = [_scene(seed) for seed in range(SCENES)]
    checks: list[tuple[str, Callable[[PlaceRecognizer, list[Image]], Outcome]]] = [
        ("min_similarity is a cosine", _min_similarity),
        ("shape (D,)", _shape),
        ("dtype float32", _dtype),
        ("finite", _finite),
        ("unit length", _unit_length),
        ("one size for all images", _one_size),
        ("same image, same embedding", _deterministic),
        ("leaves the image alone", _leaves_image),
        ("finds an image itself first", _self_match),
        ("finds it when dimmed", _dimmed),
        ("finds it when shifted", _shifted),
        ("speed", _speed),
    ]
    return Report(tuple(_run(name, run, recognizer, scenes) for name, run in checks))


def _run(
    name: str,
    run: Callable[[PlaceRecognizer, list[Image]], Outcome],
    recognizer: PlaceRecognizer,
    scenes: list[Image],
) -> Check:
    try:
        passed, detail = run(recognizer, [scene.copy() for scene in scenes])
    except Exception as error:
        return Check(name, False, " ".join(f"{type(error).__name__}: {error}".split()))
    return Check(name, passed, detail)


def _min_similarity(recognizer: PlaceRecognizer, scenes: list[Image]) -> Outcome:
    CheckedRecognizer(recognizer)
    return True, f"{recognizer.min_similarity}"


def _shape(recognizer: PlaceRecognizer, scenes: list[Image]) -> Outcome:
    shape = np.shape(recognizer.embed(scenes[0]))
    compares = hasattr(recognizer, "compare")
    return 0 not in shape and (len(shape) == 1 or (compares and len(shape) > 1)), f"{shape}"


def _dtype(recognizer: PlaceRecognizer, scenes: list[Image]) -> Outcome:
    answer: object = recognizer.embed(scenes[0])
    seen = str(answer.dtype) if isinstance(answer, np.ndarray) else type(answer).__name__
    return seen == "float32", seen


def _finite(recognizer: PlaceRecognizer, scenes: list[Image]) -> Outcome:
    black = np.zeros_like(scenes[0])
    bad = sum(int((~np.isfinite(recognizer.embed(image))).sum()) for image in (*scenes, black))
    return bad == 0, f"{bad} NaN or infinite values, a black image included"


def _unit_length(recognizer: PlaceRecognizer, scenes: list[Image]) -> Outcome:
    if hasattr(recognizer, "compare"):
        return True, "not needed: it compares its embeddings itself"
    lengths = [float(np.linalg.norm(recognizer.embed(image))) for image in scenes]
    worst = max(lengths, key=lambda length: abs(length - 1.0))
    return bool(np.allclose(lengths, 1.0, atol=1e-3)), f"furthest from 1: {worst:.6g}"


def _one_size(recognizer: PlaceRecognizer, scenes: list[Image]) -> Outcome:
    odd = [scenes[0], scenes[0][:241, :319], scenes[0][:97], scenes[0][:, :161]]
    sizes = sorted({np.shape(recognizer.embed(np.ascontiguousarray(image))) for image in odd})
    return len(sizes) == 1, f"{sizes} for 640x480, 319x241, 640x97, 161x480"


def _deterministic(recognizer: PlaceRecognizer, scenes: list[Image]) -> Outcome:
    first, again = recognizer.embed(scenes[0]), recognizer.embed(scenes[0])
    difference = float(np.abs(np.subtract(first, again)).max())
    return difference == 0.0, f"largest difference {difference:.3g}"


def _leaves_image(recognizer: PlaceRecognizer, scenes: list[Image]) -> Outcome:
    before = scenes[0].copy()
    recognizer.embed(scenes[0])
    changed = int((before != scenes[0]).sum())
    return changed == 0, f"{changed} values changed"


def _self_match(recognizer: PlaceRecognizer, scenes: list[Image]) -> Outcome:
    return _found(recognizer, scenes, scenes)


def _dimmed(recognizer: PlaceRecognizer, scenes: list[Image]) -> Outcome:
    return _found(recognizer, scenes, [(image * DIMMING).astype(np.uint8) for image in scenes])


def _shifted(recognizer: PlaceRecognizer, scenes: list[Image]) -> Outcome:
    return _found(recognizer, scenes, [np.roll(image, SHIFT_PX, axis=1) for image in scenes])


def _found(recognizer: PlaceRecognizer, places: list[Image], views: list[Image]) -> Outcome:
    index = PlaceIndex(CheckedRecognizer(recognizer))
    for image in places:
        index.add(recognizer.embed(image))
    right = 0
    for place, view in enumerate(views):
        ids, similarities = index.query(recognizer.embed(view), count=2)
        # A tie finds nothing: an embedding that is the same for all images must not pass.
        right += int(ids[0] == place and similarities[0] > similarities[1])
    return right == len(views), f"{right} of {len(views)} generated places"


def _speed(recognizer: PlaceRecognizer, scenes: list[Image]) -> Outcome:
    ticks = [time.perf_counter()]
    for image in scenes:
        recognizer.embed(image)
        ticks.append(time.perf_counter())
    milliseconds = 1e3 * float(np.median([b - a for a, b in pairwise(ticks)]))
    return True, f"{milliseconds:.1f} ms per 640x480 image"


def _scene(seed: int) -> Image:
    """Return a (480, 640, 3) picture of a wall hung with plain and striped boards."""
    rng = np.random.default_rng(seed)
    image = np.full((HEIGHT_PX, WIDTH_PX, 3), rng.integers(60, 200, 3), np.uint8)
    for _ in range(40):
        top, left = rng.integers(0, HEIGHT_PX - 40), rng.integers(0, WIDTH_PX - 40)
        board = image[top : top + rng.integers(20, 160), left : left + rng.integers(20, 160)]
        board[:] = rng.integers(0, 256, 3)
        stripe = int(rng.integers(4, 20))
        board[:, :: 2 * stripe] = rng.integers(0, 256, 3)
        board[:: 3 * stripe] = rng.integers(0, 256, 3)
    return image
