# SPDX-License-Identifier: Apache-2.0
"""Inner loops over points, features and places, which numba compiles when they are first called.

The machine code is kept beside the source, or in the user's cache folder where that is read-only,
and found there by every later run. It is made anew, in place of what was, where a loop changes, or
anything that it takes in from elsewhere. Compiled loops let other threads run.
"""

import ctypes
import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import cached_property
from hashlib import sha256
from pathlib import Path
from types import CodeType, ModuleType
from typing import Any, TypeVar

import numba
import numpy as np
from numba.core.caching import CompileResultCacheImpl, FunctionCache
from numba.core.event import Event, Listener, TimingListener, install_listener, register
from numba.extending import intrinsic

_Function = TypeVar("_Function", bound=Callable[..., Any])
_log = logging.getLogger(__name__)


class _Files(CompileResultCacheImpl):
    """Files with a function's name but not its line: what is compiled anew replaces what was."""

    def get_filename_base(self, fullname: str, abiflags: str) -> str:
        """Return how the files of a function in this Python begin."""
        named: str = super().get_filename_base(fullname, abiflags)  # type: ignore[no-untyped-call]
        return named.replace(f"-{self.locator.get_disambiguator()}.", ".")


class _Cache(FunctionCache):
    """Machine code on disk, which a run can do without: a full disk is no reason to fail."""

    _impl_class = _Files

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
            # Numba would only ask whether the file that the function is in has changed.
            self._cache_file._source_stamp = self._made_of
            yield
        except Exception as error:
            _log.debug("compiled loops could not be kept or read: %s", error)
            with suppress(OSError):
                self._cache_file.flush()  # type: ignore[no-untyped-call]

    @cached_property
    def _made_of(self) -> str:
        """Return a hash of all that, to be asked for once what the function calls is defined."""
        parts = _ingredients(self._py_func, set())
        return sha256(b"\0".join([Path(__file__).read_bytes(), *parts])).hexdigest()

    def signatures(self, codegen: Any) -> list[Any]:
        """Return for which types of arguments the function was compiled for this processor."""
        with self._on_damage_anew():
            index: Any = self._cache_file._load_index()  # type: ignore[no-untyped-call]
            ours: Any = self._index_key  # it names the processor, too
            return [key[0] for key in index if key == ours(key[0], codegen)]
        return []


def _ingredients(function: Any, seen: set[Any]) -> Iterator[bytes]:
    """Yield what becomes machine code: a function, and all that it takes from outside."""
    seen.add(function)
    yield repr(function.__defaults__).encode()
    codes = [function.__code__]
    for code in codes:
        inner = [each for each in code.co_consts if isinstance(each, CodeType)]
        constants = [each for each in code.co_consts if each not in inner]
        yield repr((code.co_code, code.co_names, constants)).encode()
        codes += inner
        for value in _named(code.co_names, function.__globals__):
            called = getattr(value, "py_func", None)
            if called is None:
                yield _frozen(value)
            elif called not in seen:
                yield from _ingredients(called, seen)


def _named(names: tuple[str, ...], known: dict[str, Any]) -> list[Any]:
    """Return the values of names, those in modules that are named, too."""
    found = [known[name] for name in names if name in known]
    modules = [vars(each) for each in found if isinstance(each, ModuleType)]
    return found + [module[name] for module in modules for name in names if name in module]


def _frozen(value: Any) -> bytes:
    """Return what a constant is; of anything else, such as numpy's functions, the name."""
    if isinstance(value, np.ndarray):
        return repr((value.dtype.str, value.shape, value.tobytes())).encode()
    if isinstance(value, int | float | complex | str | tuple | np.generic):
        return repr(value).encode()
    return getattr(value, "__qualname__", type(value).__name__).encode()


_COMPILER, _READ_ONLY = "libllvmlite", ("r-xp", "r--p")
_DONT_NEED = 4  # MADV_DONTNEED
_loops: list[Any] = []  # that were imported so far
_COMPILE = "numba:compile"  # whatever is compiled, by one thread after the other
_clock = TimingListener()  # type: ignore[no-untyped-call]
register(_COMPILE, _clock)  # type: ignore[no-untyped-call]


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


def load_compiled() -> None:
    """Load what earlier runs compiled, for which a frame would wait."""
    for loop in _loops:
        for signature in loop._cache.signatures(loop.targetctx.codegen()):
            loop.compile(signature)
    _let_go_of_compiler()


@contextmanager
def telling_of_compiling(tell: Callable[[], None]) -> Iterator[None]:
    """Call a function once, as soon as something has to be compiled, which takes a while."""
    with install_listener(_COMPILE, _First(tell)):
        yield


def compiling_s() -> float:
    """Return for how long this process has compiled so far, seconds; loading does not count."""
    return _clock.duration if _clock.done else 0.0


class _First(Listener):
    """Passes on the first of many events, which come one within another and in any thread."""

    def __init__(self, tell: Callable[[], None]) -> None:
        self._left = [tell]

    def on_start(self, event: Event) -> None:
        """Tell of it, unless it was told."""
        with suppress(IndexError):
            self._left.pop()()

    def on_end(self, event: Event) -> None:
        """Numba asks for this, too."""


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
