# SPDX-License-Identifier: Apache-2.0
"""What a process does with memory that it has freed, where glibc can be told."""

import ctypes
from contextlib import suppress

_M_MMAP_THRESHOLD, _M_ARENA_MAX = -3, -8  # of malloc.h
_LARGE_BYTES = 4 << 20  # an image is smaller


def share_between_threads() -> None:
    """Let threads started from now on use what others freed; else each keeps it for itself.

    What is larger than an image goes back to the system at once, and grows without being copied,
    however often such arrays were freed before.
    """
    _call("mallopt", _M_ARENA_MAX, 1)
    _call("mallopt", _M_MMAP_THRESHOLD, _LARGE_BYTES)


def give_back() -> None:
    """Return freed memory to the system, where it lies in pieces too small for large arrays."""
    _call("malloc_trim", 0)


def _call(function: str, *arguments: int) -> None:
    with suppress(OSError, AttributeError, TypeError):  # another C library
        getattr(ctypes.CDLL(None), function)(*arguments)
