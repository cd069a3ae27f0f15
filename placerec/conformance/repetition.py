# SPDX-License-Identifier: Apache-2.0
"""Checks that the same image gives the same bytes, whenever and wherever it is embedded."""

import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from threading import Barrier
from typing import Any

import numpy as np
from numpy.typing import NDArray

from placerec.conformance.answer import FINITE, SHAPE
from placerec.conformance.finding import Check, Outcome, Verdict, judged
from placerec.conformance.pictures import Image, places
from placerec.conformance.subject import Subject

THREADS = 4
ROUNDS = 2
SWITCH_INTERVAL_S = 1e-5
"""Threads take turns so often that what they share is seen half done."""
MAX_KEPT_MB = 0.2
"""What the system counts wavers by less; an image kept is 0.9 MB, as floats four times as much."""

AGAIN = "the same image again"
ALONE = "whatever came before"
ANOTHER_THREAD = "in another thread"
SECOND = "by a second instance"
FRESH = "in a fresh process"


def _again(subject: Subject) -> Outcome:
    first = places()[0]
    subject.embed(first)  # what came before is another check's
    return _same([subject.embed(first)], [subject.embed(first)])


def _alone(subject: Subject) -> Outcome:
    images = places()
    backwards = [subject.embed(image) for image in reversed(images)]
    return _same([subject.embed(image) for image in images], backwards[::-1])


def _another_thread(subject: Subject) -> Outcome:
    with ThreadPoolExecutor(1) as thread:
        return _same(subject.embeddings, list(thread.map(subject.embed, places())))


def _threads_at_once(subject: Subject) -> Outcome:
    images, start = places(), Barrier(THREADS)
    orders = [np.roll(np.arange(len(images)), k).tolist() * ROUNDS for k in range(THREADS)]

    def work(order: list[int]) -> list[NDArray[Any]]:
        start.wait()
        return [subject.embed(images[i]) for i in order]

    with _eager_switching(), ThreadPoolExecutor(THREADS) as threads:
        found = [embedding for row in threads.map(work, orders) for embedding in row]
    expected = [subject.embeddings[i] for order in orders for i in order]
    return _same(expected, found)


@contextmanager
def _eager_switching() -> Iterator[None]:
    usual_s = sys.getswitchinterval()
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    try:
        yield
    finally:
        sys.setswitchinterval(usual_s)


def _second_instance(subject: Subject) -> Outcome:
    if subject.name is None:
        return _nameless()
    other = subject.another()
    return _same(subject.embeddings, [other.embed(image) for image in places()])


def _fresh_process(subject: Subject) -> Outcome:
    if subject.name is None:
        return _nameless()
    return _same(subject.embeddings, list(subject.fresh_run.embeddings))


def _keeps_nothing(subject: Subject) -> Outcome:
    if subject.name is None:
        return _nameless()
    kept_mb = subject.fresh_run.kept_mb
    if np.isnan(kept_mb):
        return Outcome(Verdict.NOT_TRIED, "only Linux tells how much memory is taken")
    return judged(kept_mb <= MAX_KEPT_MB, f"{max(kept_mb, 0.0):.2f} MB more after each image")


def _nameless() -> Outcome:
    return Outcome(Verdict.NOT_TRIED, "there is no name to make another one by")


def _same(expected: Sequence[NDArray[Any]], found: Sequence[NDArray[Any]]) -> Outcome:
    pairs = list(zip(expected, found, strict=True))
    wrong = [(a, b) for a, b in pairs if a.shape != b.shape or a.tobytes() != b.tobytes()]
    if not wrong:
        return judged(True, f"{len(pairs)} of {len(pairs)} to the last bit")
    gaps = [float(np.abs(a - b).max()) for a, b in wrong if a.shape == b.shape]
    how = f"by up to {max(gaps):.3g}" if gaps else "in shape"
    return judged(False, f"{len(wrong)} of {len(pairs)} differ {how}")


CHECKS = (
    Check(
        AGAIN,
        _again,
        "seed what is random; switch a network to eval()",
        needs=(SHAPE, FINITE),
    ),
    Check(
        ALONE,
        _alone,
        "keep nothing on self from one image to the next",
        needs=(AGAIN,),
    ),
    Check(
        ANOTHER_THREAD,
        _another_thread,
        "SLAM embeds in a thread of its own: make nothing in __init__ that belongs to its thread",
        needs=(ALONE,),
    ),
    Check(
        "in several threads at once",
        _threads_at_once,
        "keep what is half done in local variables, not on self, or take a threading.Lock",
        needs=(ANOTHER_THREAD,),
    ),
    Check(
        SECOND,
        _second_instance,
        "seed what __init__ draws at random, or read it from a file",
        needs=(ALONE,),
    ),
    Check(
        FRESH,
        _fresh_process,
        "let nothing depend on hash() of a string, the order of a set, id(), or the time",
        needs=(SECOND,),
    ),
    Check(
        "keeps no images",
        _keeps_nothing,
        "let go of each image and what was made of it; a network works in torch.inference_mode()",
        needs=(FRESH,),
    ),
)
