# SPDX-License-Identifier: Apache-2.0
"""Output files that are either complete or not there at all."""

from pathlib import Path

from placerec import output_file
from placerec.recognizer import RecognizerError
from slam.types import SlamError


def write_atomically(path: Path, data: bytes | str) -> None:
    """Write a whole file (text as UTF-8), leaving an earlier one untouched until it is complete.

    Raises:
        SlamError: the folder is missing or not writable, the disk is full, or the like.
    """
    content = data.encode("utf-8") if isinstance(data, str) else data
    try:
        output_file.write_atomically(path, content)
    except RecognizerError as error:
        raise SlamError(str(error)) from error
