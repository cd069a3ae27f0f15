# SPDX-License-Identifier: Apache-2.0
"""Inner loops over points and features, compiled by numba when they are first called.

The machine code is kept beside the source, or in the user's cache folder where that is read-only,
and found there by every later run. Compiled loops let other threads of Python run.
"""

import logging
from collections.abc import Callable
from typing import Any, TypeVar

import numba
from numba.core.caching import FunctionCache
from numba.extending import intrinsic

_Function = TypeVar("_Function", bound=Callable[..., Any])
_log = logging.getLogger(__name__)


class _Cache(FunctionCache):  # type: ignore[misc]
    """Machine code on disk, which a run can do without: a full disk is no reason to fail."""

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled, if there is room."""
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _log.debug("the compiled loops could not be kept: %s", error)


def compiled(function: _Function) -> _Function:
    """Compile a function of arrays and numbers; the same as plain Python, but for the time."""
    dispatcher: Any = numba.njit(nogil=True, error_model="numpy")(function)
    try:
        dispatcher._cache = _Cache(function)
    except RuntimeError as error:  # no folder to write into
        _log.debug("loops are compiled by every run: %s", error)
    return dispatcher  # type: ignore[no-any-return]


@intrinsic  # type: ignore[untyped-decorator]
def count_bits(_context: Any, word: Any) -> tuple[Any, Any]:
    """Return how many bits of a 64-bit word are set; in compiled loops alone."""

    def generate(_context: Any, builder: Any, _signature: Any, arguments: Any) -> Any:
        return builder.ctpop(arguments[0])

    return numba.types.uint64(numba.types.uint64), generate
