# SPDX-License-Identifier: Apache-2.0
"""What a process does with memory that it has freed, where glibc can be told."""

import ctypes
from contextlib import suppress

_M_TRIM_THRESHOLD, _M_TOP_PAD, _M_MMAP_THRESHOLD, _M_ARENA_MAX = -1, -2, -3, -8  # of malloc.h
_LARGE_BYTES = 8 << 20  # an image is smaller, and what the recognizer makes of it on the way


def share_between_threads() -> None:
    """Let threads started from now on use what others freed; else each keeps it for itself.

    What is larger than an image goes back to the system at once, and grows without being copied,
    however often such arrays were freed before. What some images take stays: to have it given
    back and taken again with each frame costs half of all the time that the system takes.
    """
    _call("mallopt", _M_ARENA_MAX, 1)
    _call("mallopt", _M_MMAP_THRESHOLD, _LARGE_BYTES)
    _call("mallopt", _M_TRIM_THRESHOLD, 4 * _LARGE_BYTES)
    _call("mallopt", _M_TOP_PAD, _LARGE_BYTES // 2)


def give_back() -> None:
    """Return freed memory to the system, where it lies in pieces too small for large arrays."""
    _call("malloc_trim", 0)


def _call(function: str, *arguments: int) -> None:
    with suppress(OSError, AttributeError, TypeError):  # another C library
        getattr(ctypes.CDLL(None), function)(*arguments)
