# SPDX-License-Identifier: Apache-2.0
"""Files that are written whole or not at all, and where what can be had again is kept."""

import os
from collections.abc import Callable
from pathlib import Path

from placerec.errors import LoopcloseError

Progress = Callable[[int, int | None], None]
"""Is told how much is done, and of how much, None where nobody knows."""


def cache_folder() -> Path:
    """Return the folder of both commands: loopclose under $XDG_CACHE_HOME or ~/.cache."""
    root = os.environ.get("XDG_CACHE_HOME", "")
    return (Path(root) if Path(root).is_absolute() else Path.home() / ".cache") / "loopclose"


def write_atomically(path: Path, data: bytes | str) -> None:
    """Write a whole file (text as UTF-8), leaving an earlier one untouched until it is complete.

    Names of files that are not UTF-8 are written with escapes for what is not.

    Raises:
        LoopcloseError: the folder is missing or not writable, the disk is full, or the like.
    """
    content = data.encode("utf-8", "backslashreplace") if isinstance(data, str) else data
    # In the same folder, because a file can only be replaced atomically within one disk.
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        try:
            with partial.open("wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())  # a full disk may only show up here
            partial.replace(path)
        finally:
            partial.unlink(missing_ok=True)
    except OSError as error:
        raise LoopcloseError(
            f"cannot write {path.name}: {error.strerror}; "
            f"free the space, allow writing or choose another folder: {path}"
        ) from error
