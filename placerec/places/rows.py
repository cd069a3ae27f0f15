# SPDX-License-Identifier: Apache-2.0
"""What goes into a store of places, checked, and what comes out of it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from placerec.checked_recognizer import COSINES, MAX_LENGTH_ERROR, Embeddings, Similarities
from placerec.errors import RecognizerError

_MOST_CHARACTERS = 200
"""Of the name of a session."""


@dataclass(frozen=True)
class SeenPlace:
    """A place of the store that looks like the one asked for.

    Attributes:
        session: whose it is.
        keyframe: its number in the map of that session.
        time_s: when it was seen, seconds.
        similarity: cosine; bigger is more alike.
    """

    session: str
    keyframe: int
    time_s: float
    similarity: float


@dataclass(frozen=True)
class Rows:
    """Places of one session.

    Attributes:
        session: its name.
        keyframes: (N,) int64, their numbers in its map.
        times_s: (N,) float64, seconds.
        embeddings: (N, D) float32, of unit length.
    """

    session: str
    keyframes: NDArray[np.int64]
    times_s: NDArray[np.float64]
    embeddings: Embeddings


def checked_rows(
    session: str,
    keyframes: Sequence[int] | NDArray[np.integer],
    times_s: Sequence[float] | NDArray[np.floating],
    embeddings: Embeddings,
) -> Rows:
    """Return places of a session as they are stored.

    Raises:
        RecognizerError: they are not what they must be.
    """
    _check_session(session)
    check_embeddings(embeddings, 2)
    numbers, seconds = np.asarray(keyframes), np.asarray(times_s)
    if not numbers.shape == seconds.shape == (len(embeddings),):
        raise RecognizerError(
            f"{len(embeddings)} embeddings have keyframes of shape {numbers.shape} and times of "
            f"shape {seconds.shape}; each has one of both"
        )
    if numbers.size and (numbers.dtype.kind not in "iu" or not 0 <= numbers.min() < 2**63):
        raise RecognizerError("the numbers of keyframes must be whole, 0 or more")
    if seconds.dtype.kind not in "fiu" or not np.isfinite(seconds).all():
        raise RecognizerError("the times of keyframes must be finite numbers of seconds")
    return Rows(session, numbers.astype(np.int64), seconds.astype(np.float64), embeddings)


def check_embeddings(embeddings: Embeddings, dimensions: int) -> None:
    """Refuse what no checked recognizer makes.

    Args:
        embeddings: (D,) or (N, D).
        dimensions: 1 or 2.

    Raises:
        RecognizerError: they are not float32, not of this shape, or not of unit length.
    """
    if not isinstance(embeddings, np.ndarray) or embeddings.dtype != np.float32:
        kind = getattr(embeddings, "dtype", type(embeddings).__name__)
        raise RecognizerError(f"embeddings are {kind}; a store takes arrays of float32")
    if embeddings.ndim != dimensions or embeddings.shape[-1] == 0:
        shape = "(D,)" if dimensions == 1 else "(N, D)"
        raise RecognizerError(f"embeddings have shape {embeddings.shape}, not {shape}")
    lengths = np.atleast_1d(np.linalg.norm(embeddings.astype(np.float64), axis=-1))
    wrong = lengths[~(np.abs(lengths - 1.0) <= MAX_LENGTH_ERROR)]
    if wrong.size:
        raise RecognizerError(
            f"{wrong.size} of {lengths.size} embeddings are not of unit length, the first of them "
            f"has {wrong[0]:.6g}; a store takes what a checked recognizer makes"
        )


def conditions(
    sessions: Sequence[str] | None, recent: tuple[str, float] | None
) -> list[str | None]:
    """Return in SQL which places are looked at, those that one of these holds for; None: all.

    The places of who asks have a condition of their own: in a single one, the database would look
    up all that are older than its recent ones, thus nearly all of the store, for every query.

    Args:
        sessions: whose places; None: all.
        recent: a session and the second from which on its places are left out.

    Raises:
        RecognizerError: a name is none, or the time is not finite.
    """
    some = None
    if sessions is not None:
        some = f"session IN ({', '.join(map(_quoted, sessions))})" if sessions else "false"
    if recent is None:
        return [some]
    session, since_s = recent
    if not math.isfinite(since_s):
        raise RecognizerError(f"recent places are those since {since_s!r}; give seconds")
    own = f"session = {_quoted(session)}"
    parts = (f"NOT {own}", f"{own} AND time_s < {float(since_s)!r}")
    return [each if some is None else f"{some} AND {each}" for each in parts]


def _quoted(session: str) -> str:
    _check_session(session)
    return "'" + session.replace("'", "''") + "'"


def _check_session(session: object) -> None:
    if not (isinstance(session, str) and session.isprintable()):
        raise RecognizerError(f"a session is called {session!r}; give it a name that can be shown")
    if not 0 < len(session) <= _MOST_CHARACTERS:
        raise RecognizerError(
            f"the name of a session has {len(session)} characters; it may have 1 to "
            f"{_MOST_CHARACTERS}"
        )


def ranked(
    embedding: Embeddings,
    sessions: Sequence[str],
    keyframes: Sequence[int],
    times_s: Sequence[float],
    embeddings: Embeddings,
) -> tuple[Similarities, list[SeenPlace]]:
    """Return (N,) similarities of places to a (D,) embedding and the places, best first.

    The similarities are those of a `PlaceIndex`; equal ones are in the order of session, keyframe
    and time.
    """
    similarities = COSINES.compare(embedding[None], embeddings)[0]
    order = sorted(
        range(len(similarities)),
        key=lambda k: (-similarities[k], sessions[k], keyframes[k], times_s[k]),
    )
    seen = [SeenPlace(sessions[k], keyframes[k], times_s[k], float(similarities[k])) for k in order]
    return similarities[order], seen
