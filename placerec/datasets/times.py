# SPDX-License-Identifier: Apache-2.0
"""Times as lists tell them: in any unit, in any order, of a clock that may start again."""

from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from placerec.errors import LoopcloseError

FloatArray = NDArray[np.float64]

FRAMES_PER_S = 30.0
"""What numbers stand for where no time is given: all the cameras of these recordings ran at it."""


class Unit(NamedTuple):
    """What a time is counted in; of times between images, so many are a step at least."""

    name: str
    per_s: float
    least_step: float


SECONDS = Unit("seconds", 1.0, 0.0)
MICROSECONDS = Unit("microseconds", 1e6, 2e3)
# No camera with depth is faster than 125 Hz, and none that can be followed slower than 0.5 Hz.
_UNITS = (Unit("nanoseconds", 1e9, 2e6), MICROSECONDS, Unit("milliseconds", 1e3, 8.0), SECONDS)
_LARGEST_STEP = 2e9
_SLOWEST_COUNT = 8.0
_FRAMES = Unit(f"numbers of images, {FRAMES_PER_S:g} a second", FRAMES_PER_S, 1.0)
_EPOCH_S = (1e9, 4e9)  # times of day since 1970, from 2001 to 2096
_EPOCH_STEP_S = 20.0
_POSE_STEP_S = 0.2  # of poses that need not be of the images' time alone to be in seconds
_CLEARLY = 1.5


def unit_of(
    stamps: FloatArray, *, are_whole: bool | None = None, usual: Unit = SECONDS
) -> Unit | None:
    """Return what the times of (N,) images are in, by their steps; None where nothing fits.

    Args:
        stamps: as they are written, in any order.
        are_whole: they are written without a point; None where that is not known.
        usual: what they are in where their steps do not contradict it.
    """
    step = _step(stamps)
    for unit in _UNITS:
        first_s, last_s = stamps.min() / unit.per_s, stamps.max() / unit.per_s
        is_epoch = _EPOCH_S[0] <= first_s and last_s <= _EPOCH_S[1]
        if is_epoch and step <= _EPOCH_STEP_S * unit.per_s:
            return unit
    if not step or usual.least_step <= step < 1e3 * usual.least_step:
        return usual
    if are_whole is False and _is_whole(stamps) and step < 1e3:
        return SECONDS  # 10.000000 and 20.000000: views one by one
    if _is_whole(stamps) and step < _SLOWEST_COUNT:
        return _FRAMES
    if step >= _LARGEST_STEP:
        return None
    return next(unit for unit in _UNITS if step >= unit.least_step)


def in_seconds(
    stamps: FloatArray,
    file: Path,
    warnings: list[str],
    *,
    are_whole: bool | None = None,
    usual: Unit = SECONDS,
) -> FloatArray:
    """Return the times of (N,) images in seconds, and say so where they were in another unit.

    Raises:
        LoopcloseError: their steps fit no unit.
    """
    unit = unit_of(stamps, are_whole=are_whole, usual=usual)
    if unit is None:
        raise LoopcloseError(
            f"times follow each other by {_step(stamps):g}; seconds, milliseconds, microseconds or"
            f" nanoseconds are expected: {file}"
        )
    if unit != usual:
        warnings.append(f"{file.name} steps by {_step(stamps):g} and was read as {unit.name}")
    return stamps / unit.per_s


def like_images(
    stamps: FloatArray, images_s: FloatArray, file: Path, warnings: list[str]
) -> FloatArray:
    """Return the times of (N,) poses in seconds, in the unit that lays them on (M,) images' times.

    They may be numbers of the images too, counted from 0 or 1. Where no unit does, they are taken
    to be seconds.
    """
    numbered_s = _numbered(stamps, images_s)
    read: dict[str, FloatArray] = {
        unit.name: stamps / unit.per_s
        for unit in (*reversed(_UNITS), *(() if numbered_s is None else (_FRAMES,)))
    }
    if numbered_s is not None:
        read["numbers of the images"] = numbered_s
    are_seconds = not _is_whole(stamps) and _step(stamps) <= _POSE_STEP_S
    if are_seconds and _common(stamps, images_s) > 0.0:
        return stamps
    shares = [_common(stamps_s, images_s) for stamps_s in read.values()]
    best = int(np.argmax(shares))
    name, stamps_s = list(read.items())[best if shares[best] > _CLEARLY * shares[0] else 0]
    if name != SECONDS.name:
        warnings.append(
            f"the times of {file.name} were read as {name}, which lays them on the images'"
        )
    return stamps_s


def _is_whole(stamps: FloatArray) -> bool:
    return bool((stamps == np.floor(stamps)).all())


def _step(stamps: FloatArray) -> float:
    """Return the median of the steps between different times, 0 where there is none."""
    steps = np.diff(np.unique(stamps))
    return float(np.median(steps)) if len(steps) else 0.0


def _common(stamps_s: FloatArray, images_s: FloatArray) -> float:
    """Return how much of the time that either takes both have in common."""
    # A hair longer than they are, so that single poses have a length.
    start_s, end_s = stamps_s.min() - 1e-3, stamps_s.max() + 1e-3
    first_s, last_s = images_s.min() - 1e-3, images_s.max() + 1e-3
    common_s = min(end_s, last_s) - max(start_s, first_s)
    return max(0.0, float(common_s / (max(end_s, last_s) - min(start_s, first_s))))


def _numbered(stamps: FloatArray, images_s: FloatArray) -> FloatArray | None:
    """Return the times of the images that stamps count, None where they cannot be numbers."""
    is_within = stamps.min() >= 0 and stamps.max() <= len(images_s)
    if not _is_whole(stamps) or not is_within or 2 * np.ptp(stamps) < len(images_s):
        return None
    first = int(stamps.min() >= 1 and stamps.max() == len(images_s))
    sorted_s = np.sort(images_s)
    return np.asarray(sorted_s[np.minimum(stamps.astype(int) - first, len(images_s) - 1)])


_JUMP_STEPS = 2.5  # by which a late frame is not yet a clock that starts again
_PIECES = 3
_PAUSE_S = 10.0
_MANY_EQUAL = 0.2


class Clock(NamedTuple):
    """How the times of sessions, whose clock started again with each, become those of one clock.

    Attributes:
        offsets_s: (S,) what is added to each session's times.
        ends_s: (S - 1,) when a session is over and the next begins, by the one clock.
    """

    offsets_s: FloatArray
    ends_s: FloatArray


class Timeline(NamedTuple):
    """The lines of a list in the order of time.

    Attributes:
        kept: M numbers of lines, from 0; of equal times the first.
        times_s: (M,) their times, strictly increasing.
        clock: that of the list.
    """

    kept: list[int]
    times_s: FloatArray
    clock: Clock


def in_order(
    stamps_s: FloatArray, file: Path, warnings: list[str], clock: Clock | None = None
) -> Timeline:
    """Put (N,) times in order; where the clock starts again, what follows is moved behind.

    Args:
        stamps_s: as listed, N > 0.
        file: that they are from.
        warnings: get a sentence for all that is done.
        clock: of the images, where these times are by the same; it starts again as often.

    Raises:
        LoopcloseError: it does not start again as often, or so many times are equal that they must
            have been rounded.
    """
    sessions = _sessions(stamps_s)
    if clock is None:
        clock = _clock(stamps_s, sessions)
        if len(sessions) > 1:
            warnings.append(_started_again(file, clock))
    if len(sessions) != len(clock.offsets_s):
        raise LoopcloseError(
            f"the clock of {file.name} starts again {len(sessions) - 1} time(s), that of the images"
            f" {len(clock.offsets_s) - 1} time(s), so that what belongs together is not known;"
            f" write the times of one clock: {file}"
        )
    bounds_s = [-np.inf, *clock.ends_s, np.inf]
    kept: list[int] = []
    times_s: list[FloatArray] = []
    equal = 0
    for lines, offset_s, (start_s, end_s) in zip(
        sessions, clock.offsets_s, pairwise(bounds_s), strict=True
    ):
        moved_s = stamps_s[lines] + offset_s
        order = np.argsort(moved_s, kind="stable")
        ordered_s = moved_s[order]
        is_new = np.concatenate([[True], np.diff(ordered_s) > 0.0])
        equal += int((~is_new).sum())
        used = is_new & (ordered_s >= start_s) & (ordered_s < end_s)
        kept += lines[order[used]].tolist()
        times_s.append(ordered_s[used])
    if any((np.diff(stamps_s[lines]) < 0.0).any() for lines in sessions):
        warnings.append(f"{file.name} is not in the order of time; it was sorted")
    if equal > _MANY_EQUAL * len(stamps_s):
        raise LoopcloseError(
            f"{equal} of {len(stamps_s)} lines have the time of another, as if times had been"
            f" rounded; write them with three decimals of a second at least: {file}"
        )
    if equal:
        warnings.append(
            f"{file.name} has {equal} line(s) whose timestamp came before; the first of each was"
            " used"
        )
    return Timeline(kept, np.concatenate(times_s), clock)


def _started_again(file: Path, clock: Clock) -> str:
    offsets = " and ".join(f"{offset_s:.3f} s" for offset_s in clock.offsets_s[1:])
    return (
        f"the clock of {file.name} starts again {len(clock.ends_s)} time(s); what follows is taken"
        f" for a session of its own, and {offsets} later than it says"
    )


def _clock(stamps_s: FloatArray, sessions: list[NDArray[np.int64]]) -> Clock:
    offsets_s, ends_s = [0.0], []
    for before, after in pairwise(sessions):
        last_s = stamps_s[before].max() + offsets_s[-1]
        ends_s.append(last_s + 0.5 * _PAUSE_S)
        offsets_s.append(last_s + _PAUSE_S - stamps_s[after].min())
    return Clock(np.array(offsets_s), np.array(ends_s))


def _sessions(stamps_s: FloatArray) -> list[NDArray[np.int64]]:
    """Return the lines of each session: more than one only where sorting would mix them up.

    A list that is out of order falls into pieces too, but sorting makes it whole again: each piece
    comes to lie in a few places, where two sessions of one length would take turns.
    """
    everything = np.arange(len(stamps_s))
    jumps = np.flatnonzero(np.diff(stamps_s) < -_JUMP_STEPS * _step(stamps_s)) + 1
    pieces = np.split(everything, jumps)
    labels = np.repeat(np.arange(len(pieces)), [len(piece) for piece in pieces])
    turns = np.count_nonzero(np.diff(labels[np.argsort(stamps_s, kind="stable")]))
    return pieces if turns > _PIECES * len(pieces) else [everything]
