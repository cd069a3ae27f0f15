# SPDX-License-Identifier: Apache-2.0
"""Inner loops over points and features, which numba compiles when they are first called.

The machine code is kept beside the source, or in the user's cache folder where that is read-only,
and found there by every later run. It is made anew where the file of a loop changes, but not where
a constant or an inlined function that it imports does. Compiled loops let other threads run.
"""

import ctypes
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np
from numba.core.caching import FunctionCache
from numba.extending import intrinsic

_Function = TypeVar("_Function", bound=Callable[..., Any])
_log = logging.getLogger(__name__)


class _Cache(FunctionCache):
    """Machine code on disk, which a run can do without: a full disk is no reason to fail."""

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return what was compiled for these types, None if there is nothing that can be used."""
        with self._on_damage_anew():
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]
        return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled, if there is room."""
        with self._on_damage_anew():
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]

    @contextmanager
    def _on_damage_anew(self) -> Iterator[None]:
        """Forget a file that a power cut left empty, say, whatever reading it raises."""
        try:
            yield
        except Exception as error:
            _log.debug("compiled loops could not be kept or read: %s", error)
            with suppress(OSError):
                self._cache_file.flush()  # type: ignore[no-untyped-call]

    def signatures(self) -> list[Any]:
        """Return for which types of arguments the function was compiled here."""
        with self._on_damage_anew():
            return self._signatures()
        return []

    def _signatures(self) -> list[Any]:
        index: dict[Any, str] = self._cache_file._load_index()  # type: ignore[no-untyped-call]
        return [key[0] for key in index]


_COMPILER, _READ_ONLY = "libllvmlite", ("r-xp", "r--p")
_DONT_NEED = 4  # MADV_DONTNEED
_loops: list[Any] = []  # that were imported so far


def compiled(function: _Function) -> _Function:
    """Compile a function of arrays and numbers; the same as plain Python, but for the time."""
    dispatcher: Any = numba.njit(nogil=True, error_model="numpy")(function)
    try:
        dispatcher._cache = _Cache(function)  # type: ignore[no-untyped-call]
        _loops.append(dispatcher)
    except RuntimeError as error:  # no folder to write into
        _log.debug("loops are compiled by every run: %s", error)
    return dispatcher  # type: ignore[no-any-return]


def inlined(function: _Function) -> _Function:
    """Compile a function that compiled ones call, as a part of each of them."""
    return numba.njit(nogil=True, error_model="numpy")(function)  # type: ignore[return-value]


def load_compiled() -> bool:
    """Load what earlier runs compiled, for which a frame would wait; return if there is any."""
    found = [(loop, signature) for loop in _loops for signature in loop._cache.signatures()]
    for loop, signature in found:
        loop.compile(signature)
    _let_go_of_compiler()
    return bool(found)


def _let_go_of_compiler() -> None:
    """Return the memory of LLVM's code and constants, 70 MB, where the system can be told to.

    Linux reads them from their file again if something is to be compiled after all.
    """
    with suppress(OSError, ValueError, AttributeError):
        madvise = ctypes.CDLL(None).madvise
        for addresses in _unchanged_parts(_COMPILER):
            start, end = (int(each, 16) for each in addresses.split("-"))
            madvise(ctypes.c_void_p(start), ctypes.c_size_t(end - start), _DONT_NEED)


def _unchanged_parts(library: str) -> list[str]:
    """Return the addresses of what is in memory as it is in a library's file."""
    found, addresses = [], ""
    for line in Path("/proc/self/smaps").read_text().splitlines():
        name, *values = line.split()
        if not name.endswith(":"):  # what follows is of another part
            addresses = name if values[0] in _READ_ONLY and library in values[-1] else ""
        elif name in ("Anonymous:", "Swap:") and values[0] != "0":
            addresses = ""  # its own, and nowhere else
        elif name == "VmFlags:" and addresses:  # the last line of a part
            found.append(addresses)
    return found


def _count_bits(_context: Any, _word: Any) -> tuple[Any, Any]:
    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return numba.types.uint64(numba.types.uint64), generate


_intrinsic: Any = intrinsic(_count_bits)
count_bits: Callable[[np.uint64], int] = _intrinsic
"""Tells how many bits of a 64-bit word are set; in compiled loops alone."""
