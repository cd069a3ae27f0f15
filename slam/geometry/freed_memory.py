# SPDX-License-Identifier: Apache-2.0
"""What a process does with memory that it has freed, where glibc can be told."""

import ctypes
from contextlib import suppress

_M_ARENA_MAX = -8  # of malloc.h


def share_between_threads() -> None:
    """Let threads started from now on use what others freed; else each keeps it for itself."""
    _call("mallopt", _M_ARENA_MAX, 1)


def give_back() -> None:
    """Return freed memory to the system, where it lies in pieces too small for large arrays."""
    _call("malloc_trim", 0)


def _call(function: str, *arguments: int) -> None:
    with suppress(OSError, AttributeError, TypeError):  # another C library
        getattr(ctypes.CDLL(None), function)(*arguments)
