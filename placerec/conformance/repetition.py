# SPDX-License-Identifier: Apache-2.0
"""Checks that an image gives the same bytes whenever and wherever, and is then let go of."""

import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Barrier
from time import perf_counter, sleep
from types import FrameType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placerec.conformance.answer import finite, one_shape
from placerec.conformance.made_images import Image, places
from placerec.conformance.side_effects import gives_away, leaves_image, leaves_settings
from placerec.conformance.subject import Outcome, Subject, Verdict, as_check
from placerec.recognizer import load

_AGAINS = 3
_THREADS = 4
_FEW = 3
_MANY = 256
_PATIENCE_S = 5.0
"""For so many; one that takes long for an image is asked fewer times."""
_ROUNDING = 1e-3
"""Sums over an image may be taken in the order in which it lies in memory."""
_PAUSES = 500
"""In each thread; the lines after that run on."""
_PAUSE_S = 1e-5
_MAX_KEPT_MB = 0.4
"""Half an image: what the system counts wavers by less."""


@as_check(
    "the same image again",
    "keep nothing on self; draw from a default_rng(0) made in embed; put a network in eval()",
    one_shape,
    finite,
)
def _again(subject: Subject) -> Outcome:
    first = places()[0]
    subject.embed(first)  # what came before is another check's
    return _same([subject.embed(first)] * _AGAINS, [subject.embed(first) for _ in range(_AGAINS)])


@as_check("whatever came before", "keep nothing on self from one image to the next", _again)
def _alone(subject: Subject) -> Outcome:
    backwards = [subject.embed(image) for image in reversed(places())]
    return _same(subject.embeddings, backwards[::-1])


@as_check(
    "after many images",
    "keep no answers: a cache that is full, or a ring that has come round, returns old ones",
    _alone,
    gives_away,
)
def much_later(subject: Subject) -> Outcome:
    """Having seen many images, it answers as before, and to each image anew."""
    images = places()
    early = [np.asarray(subject.recognizer.embed(image.copy())) for image in images[:_FEW]]
    seen = {embedding.tobytes(): i for i, embedding in enumerate(subject.embeddings)}
    tells_apart = len(seen) == len(images)
    others, start_s = 0, perf_counter()
    while others < _MANY and perf_counter() - start_s < _PATIENCE_S:
        others += 1
        place = others % len(images)
        answer = subject.embed(np.roll(images[place], others, axis=1)).tobytes()
        if tells_apart and seen.setdefault(answer, place) != place:
            return False, f"after {others} others, the answer to another image"
    # Those returned early, as they are by now, and those returned late.
    found = [*early, *(subject.embed(image) for image in images)]
    is_same, says = _same(subject.embeddings[:_FEW] + subject.embeddings, found)
    return is_same, f"{says}, after {others} others"


@as_check(
    "however it lies in memory",
    "begin with image = np.array(image): rows may be apart, turned round or read-only",
    leaves_image,
    much_later,
)
def _any_layout(subject: Subject) -> Outcome:
    usual = subject.embeddings[0]
    for title, image in _layouts(places()[0]):
        try:
            embedding = np.asarray(subject.recognizer.embed(image))
        except Exception as error:
            return False, f"{title}: {subject.explain(error)}"
        gap, largest = np.abs(embedding - usual).max(), np.abs(usual).max()
        if gap > _ROUNDING * largest:
            return False, f"{title}: differs by up to {gap:.3g}, of {largest:.3g} at most"
    return True, ", ".join(title for title, _ in _layouts(places()[0]))


def _layouts(image: Image) -> Iterator[tuple[str, Image]]:
    """Return an image as others make it without copying."""
    yield "BGR turned round", image[..., ::-1].copy()[..., ::-1]
    yield "cut out", np.pad(image, ((8, 8), (8, 8), (0, 0)))[8:-8, 8:-8]
    yield "column by column", np.asfortranarray(image)
    frozen = image.copy()
    frozen.flags.writeable = False
    yield "read-only", frozen


@as_check(
    "in another thread",
    "SLAM embeds in a thread of its own: __init__ must make nothing that belongs to its thread",
    much_later,
)
def _another_thread(subject: Subject) -> Outcome:
    with ThreadPoolExecutor(1) as thread:
        return _same(subject.embeddings, list(thread.map(subject.embed, places())))


@as_check(
    "in several threads at once",
    "keep what is half done in local variables, not on self, or take a threading.Lock",
    _another_thread,
)
def _threads_at_once(subject: Subject) -> Outcome:
    images, start = places(), Barrier(_THREADS)
    orders = [np.roll(np.arange(len(images)), k).tolist() for k in range(_THREADS)]

    def work(order: list[int]) -> list[NDArray[Any]]:
        start.wait()
        with _hesitating(subject):
            return [subject.embed(images[i]) for i in order]

    with ThreadPoolExecutor(_THREADS) as threads:
        found = [embedding for row in threads.map(work, orders) for embedding in row]
    expected = [subject.embeddings[i] for order in orders for i in order]
    return _same(expected, found)


@contextmanager
def _hesitating(subject: Subject) -> Iterator[None]:
    """Let other threads have their turn between any two lines of the recognizer's own code.

    Left to itself, a thread is interrupted so rarely that it would take luck to see what two of
    them have in common.
    """
    pauses = iter(range(_PAUSES))

    def pause(frame: FrameType, event: str, argument: object) -> "Callable[..., Any] | None":
        if not subject.owns(frame) or next(pauses, None) is None:
            return None
        sleep(_PAUSE_S)
        return pause

    before = sys.gettrace()
    sys.settrace(pause)
    try:
        yield
    finally:
        sys.settrace(before)


@as_check(
    "by a second instance",
    "give what __init__ draws its own default_rng(0), or read it from a file",
    much_later,
    leaves_settings,
)
def _second_instance(subject: Subject) -> Outcome:
    other = Subject(load(subject.name), subject.name)
    return _same(subject.embeddings[:_FEW], [other.embed(image) for image in places()[:_FEW]])


@as_check(
    "in a fresh process",
    "depend on nothing else: hash() of a string, the order of a set, id(), the time",
    _second_instance,
)
def fresh_process(subject: Subject) -> Outcome:
    """Another Python makes the same embeddings."""
    return _same(subject.embeddings, list(subject.fresh_run.embeddings))


def _same(expected: Sequence[NDArray[Any]], found: Sequence[NDArray[Any]]) -> Outcome:
    pairs = list(zip(expected, found, strict=True))
    wrong = [(a, b) for a, b in pairs if a.shape != b.shape or a.tobytes() != b.tobytes()]
    if not wrong:
        return True, f"{len(pairs)} of {len(pairs)} to the last bit"
    gaps = [float(np.abs(a - b).max()) for a, b in wrong if a.shape == b.shape]
    how = f"by up to {max(gaps):.3g}" if gaps else "in shape"
    return False, f"{len(wrong)} of {len(pairs)} differ {how}"


@as_check(
    "keeps no images",
    "let go of each image and what was made of it; run a network in torch.inference_mode()",
    fresh_process,
)
def _keeps_no_images(subject: Subject) -> Outcome:
    kept_mb = subject.fresh_run.kept_mb
    if np.isnan(kept_mb):
        return Verdict.NOT_TRIED, "only Linux tells how much memory is taken"
    return kept_mb <= _MAX_KEPT_MB, f"{max(kept_mb, 0.0):.2f} MB more after each image"


@as_check(
    "several at once",
    "embed_many(images) gives what embed does of each, in their order; or leave it out",
    much_later,
)
def _at_once(subject: Subject) -> Outcome:
    embed_many = getattr(subject.recognizer, "embed_many", None)
    if embed_many is None:
        return True, "it has no embed_many, and is asked for one after the other"
    found = [np.asarray(each) for each in embed_many([image.copy() for image in places()])]
    shapes = [each.shape for each in subject.embeddings]
    if [each.shape for each in found] != shapes:
        return False, f"{len(found)} of {len(shapes)} embeddings, or others in shape"
    gaps = [np.abs(a - b).max() for a, b in zip(subject.embeddings, found, strict=True)]
    largest = max(np.abs(each).max() for each in subject.embeddings)
    return max(gaps) <= _ROUNDING * largest, f"differ by up to {max(gaps):.3g}, of {largest:.3g}"


CHECKS = (
    _again,
    _alone,
    much_later,
    _any_layout,
    _another_thread,
    _threads_at_once,
    _at_once,
    _second_instance,
    fresh_process,
)
COSTS = (_keeps_no_images,)
