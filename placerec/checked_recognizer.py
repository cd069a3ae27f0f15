# SPDX-License-Identifier: Apache-2.0
"""A recognizer whose every answer is checked, and how its embeddings are compared."""

import queue
import threading
import weakref
from collections.abc import Callable, Sequence
from concurrent.futures import Future, wait
from typing import Any, NoReturn, Protocol, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from placerec.errors import RecognizerError, cause_of
from placerec.recognizer import PlaceRecognizer, with_members

Embeddings = NDArray[np.float32]
Similarities = NDArray[np.float32]

_Kind = TypeVar("_Kind")
MAX_LENGTH_ERROR = 1e-3
_LOOKS_BACK = 32
_MAX_BEYOND_ONE = 1e-3
"""Rounding may take a similarity so far out of -1 to 1; it is brought back."""


class Comparer(Protocol):
    """Compares embeddings.

    Attributes:
        looks_back: the rows of queries before the one in question that matter to its answer.
    """

    looks_back: int

    def compare(self, queries: Embeddings, references: Embeddings) -> Similarities:
        """Return (Q, R) float32 similarities, -1 to 1, of (Q, *S) queries and (R, *S) references.

        Both are in the order in which they were seen.
        """
        ...


class Cosines:
    """Compares (D,) embeddings of unit length by their cosine, each pair on its own."""

    looks_back = 0

    def compare(self, queries: Embeddings, references: Embeddings) -> Similarities:
        """Return the (Q, R) float32 cosines of (Q, D) queries and (R, D) references."""
        # Not `@`: BLAS adds up a pair in an order that depends on where it stands and on the
        # number of cores, and two equal places would differ in the last bit instead of tying.
        products = np.einsum("qd,rd->qr", queries, references)
        similarities: Similarities = np.clip(products, -1.0, 1.0)
        return similarities


COSINES = Cosines()


def flaw_in(answer: object, shape: tuple[int, int]) -> str | None:
    """Return what is wrong with an answer that should be (Q, R) similarities, None if nothing.

    Args:
        answer: whatever a recognizer returned.
        shape: (Q, R).
    """
    try:
        values = np.asarray(answer, dtype=np.float64)
    except Exception:  # whatever the answer's own kind raises
        return f"a {type(answer).__name__} that is not an array of numbers"
    if values.shape != shape:
        return f"similarities of shape {values.shape}, not (queries, references) = {shape}"
    if count := np.count_nonzero(~np.isfinite(values)):
        return f"{count} of {values.size} similarities that are NaN or infinite"
    outside = values[np.abs(values) > 1.0 + _MAX_BEYOND_ONE]
    if outside.size:
        worst = outside[np.abs(outside).argmax()]
        return f"a similarity of {worst:.6g}; it must lie from -1 to 1"
    return None


def flaw_in_scores(answer: object, count: int) -> str | None:
    """Return what is wrong with an answer that should be (count,) scores, None if nothing."""
    try:
        values = np.asarray(answer, dtype=np.float64)
    except Exception:  # whatever the answer's own kind raises
        return f"a {type(answer).__name__} that is not an array of numbers"
    if values.shape != (count,):
        return f"scores of shape {values.shape}, not (candidates,) = {(count,)}"
    outside = values[~((values >= 0.0) & (values <= 1.0))]
    return f"a score of {outside[0]:.6g}; it must lie from 0 to 1" if outside.size else None


class _Helper:
    """A thread that is asked, and left to itself where it does not answer in time.

    Nobody waits for it when the process ends.
    """

    def __init__(self, limit_s: float) -> None:
        self._limit_s = limit_s
        self._questions: queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None]
        self._questions = queue.SimpleQueue()
        self._is_stuck = False
        threading.Thread(target=_answer, args=(self._questions,), daemon=True).start()
        weakref.finalize(self, self._questions.put, None)

    def ask(self, question: Callable[[], object]) -> object:
        """Return the answer, or raise what it raised.

        Raises:
            RecognizerError: it took, or once took, longer than the limit.
        """
        answer: Future[object] = Future()
        if not self._is_stuck:
            self._questions.put((answer, question))
            self._is_stuck = not wait([answer], self._limit_s).done
        if self._is_stuck:
            raise RecognizerError(f"no answer within {self._limit_s:g} s")
        return answer.result()


def _answer(questions: "queue.SimpleQueue[tuple[Future[Any], Callable[[], Any]] | None]") -> None:
    while asked := questions.get():
        future, question = asked
        try:
            future.set_result(question())
        except (Exception, SystemExit) as error:
            future.set_exception(error)
        except BaseException as error:  # nobody else's: signals go to the main thread
            future.set_exception(RuntimeError(cause_of(error)))
        del asked, future, question


def _ask_here(question: Callable[[], object]) -> object:
    return question()


class CheckedRecognizer:
    """A recognizer whose every answer is checked, so that its callers need not doubt it.

    It always has `compare`: by cosine, unless the recognizer has its own.

    Attributes:
        min_similarity: similarity from which a match is worth verifying, finite, -1 to 1.
        can_rerank: whether the recognizer has a `rerank` of its own.
        looks_back: how many queries before the one in question matter to its similarities.
    """

    def __init__(
        self, recognizer: PlaceRecognizer, name: str | None = None, limit_s: float | None = None
    ) -> None:
        """Wrap a recognizer; the name is what errors call it, by default its class's.

        Where there is a limit it is asked in a thread of its own, and fails once it takes longer.

        Raises:
            RecognizerError: a member is missing or is not what it must be.
        """
        self._title = f"recognizer {name or type(recognizer).__name__!r}"
        self._recognizer = with_members(recognizer, self._title)
        self._shape: tuple[int, ...] | None = None
        own = getattr(recognizer, "compare", None)
        if own is not None and not callable(own):
            raise RecognizerError(f"{self._title} has a compare that is no method")
        self._rerank = getattr(recognizer, "rerank", None)
        self.can_rerank = self._rerank is not None
        if self.can_rerank and not callable(self._rerank):
            raise RecognizerError(f"{self._title} has a rerank that is no method")
        self._comparer = COSINES if own is None else cast(Comparer, recognizer)
        try:
            self.min_similarity = float(recognizer.min_similarity)
        except (TypeError, ValueError):
            self.min_similarity = np.nan
        if not -1.0 <= self.min_similarity <= 1.0:
            raise RecognizerError(
                f"{self._title} has min_similarity = {recognizer.min_similarity!r}; "
                "it must lie from -1 to 1"
            )
        looks_back: object = getattr(self._comparer, "looks_back", _LOOKS_BACK)
        if not isinstance(looks_back, int) or looks_back < 0:
            raise RecognizerError(
                f"{self._title} has looks_back = {looks_back!r}; it must be 0 or more"
            )
        self.looks_back = looks_back
        self._ask = _ask_here if limit_s is None else _Helper(limit_s).ask

    @property
    def comparer(self) -> Comparer:
        """What compares its embeddings: itself, or COSINES unless the recognizer has its own."""
        return COSINES if self._comparer is COSINES else self

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the float32 embedding of a (H, W, 3) uint8 RGB image.

        It is (D,) and of unit length; of another shape only if the recognizer compares its own.

        Raises:
            RecognizerError: the recognizer failed, or its answer is not finite, not of the shape
                as before, or not the unit vector that it must be.
        """
        return self._embedding(self._asked(lambda: self._recognizer.embed(image)))

    def embed_many(self, images: Sequence[NDArray[np.uint8]]) -> list[NDArray[np.float32]]:
        """Return the embeddings of (H, W, 3) uint8 RGB images, as `embed` does, of any sizes.

        Several are made at once where the recognizer has a method `embed_many(images)` for that.

        Raises:
            RecognizerError: as for `embed`, or there are not as many embeddings as images.
        """
        at_once: object = getattr(self._recognizer, "embed_many", None)
        if len(images) < 2 or not callable(at_once):
            return [self.embed(image) for image in images]
        answer = self._asked(lambda: list(at_once(images)))
        if len(answer) != len(images):
            self._refuse(f"{len(answer)} embeddings of {len(images)} images")
        return [self._embedding(each) for each in answer]

    def compare(self, queries: Embeddings, references: Embeddings) -> Similarities:
        """Return (Q, R) float32 similarities as a `Comparer` does.

        Raises:
            RecognizerError: the recognizer failed, or its answer is no such similarities.
        """
        try:
            ask = _ask_here if self._comparer is COSINES else self._ask
            answer = ask(lambda: self._comparer.compare(queries, references))
        except (Exception, SystemExit) as error:
            raise RecognizerError(f"{self._title} failed to compare: {cause_of(error)}") from error
        if flaw := flaw_in(answer, (len(queries), len(references))):
            self._refuse(flaw)
        return np.clip(np.asarray(answer, np.float32), -1.0, 1.0)

    def rerank(
        self, query: NDArray[np.uint8], candidates: Sequence[NDArray[np.uint8]]
    ) -> NDArray[np.float64]:
        """Return (C,) float64 scores, 0 to 1, of images that look like another: its second look.

        Raises:
            RecognizerError: it has none, it failed, or its answer is no such scores.
        """
        rerank = self._rerank
        if rerank is None:
            raise RecognizerError(f"{self._title} has no method rerank(query, candidates)")
        try:
            answer = self._ask(lambda: rerank(query, candidates))
        except (Exception, SystemExit) as error:
            raise RecognizerError(f"{self._title} failed to rerank: {cause_of(error)}") from error
        if flaw := flaw_in_scores(answer, len(candidates)):
            self._refuse(flaw)
        return np.asarray(answer, np.float64)

    def _asked(self, question: Callable[[], _Kind]) -> _Kind:
        try:
            return cast(_Kind, self._ask(question))
        except (Exception, SystemExit) as error:
            raise RecognizerError(f"{self._title} failed: {cause_of(error)}") from error

    def _embedding(self, answer: object) -> NDArray[np.float32]:
        values = self._array(answer)
        return self._unit_vector(values) if self._comparer is COSINES else values.astype(np.float32)

    def _array(self, answer: object) -> NDArray[np.float64]:
        try:
            values = np.asarray(answer, dtype=np.float64)
        except Exception as error:
            self._refuse(f"a {type(answer).__name__} that is not an array of numbers", error)
        if values.size == 0 or values.ndim == 0 or (values.ndim > 1 and self._comparer is COSINES):
            self._refuse(f"an array of shape {values.shape}; embed must return shape (D,)")
        if count := np.count_nonzero(~np.isfinite(values)):
            self._refuse(f"{count} of {values.size} values that are NaN or infinite")
        if self._shape not in (None, values.shape):
            self._refuse(f"an array of shape {values.shape} after {self._shape} for earlier images")
        self._shape = values.shape
        return values

    def _unit_vector(self, vector: NDArray[np.float64]) -> NDArray[np.float32]:
        length = float(np.linalg.norm(vector))
        if not abs(length - 1.0) <= MAX_LENGTH_ERROR:
            self._refuse(f"a vector of length {length:.6g}; divide it by its length")
        return (vector / length).astype(np.float32)

    def _refuse(self, what: str, cause: Exception | None = None) -> NoReturn:
        raise RecognizerError(f"{self._title} returned {what}") from cause
