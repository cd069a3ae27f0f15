# SPDX-License-Identifier: Apache-2.0
"""Output files that are either complete or not there at all."""

import os
from pathlib import Path

from placerec.recognizer import RecognizerError


def write_atomically(path: Path, content: bytes) -> None:
    """Write a whole file, leaving an earlier one untouched until it is complete.

    Raises:
        RecognizerError: the folder is missing or not writable, the disk is full, or the like.
    """
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
        raise RecognizerError(
            f"cannot write {path.name}: {error.strerror}; "
            f"free the space, allow writing or choose another folder: {path}"
        ) from error
