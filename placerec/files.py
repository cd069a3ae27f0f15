# SPDX-License-Identifier: Apache-2.0
"""Files: how they are opened, written whole or not at all, and where a cache of them is kept."""

import codecs
import io
import json
import os
import stat
import tomllib
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from placerec.errors import LoopcloseError

Progress = Callable[[int, int | None], None]
"""Is told how much is done, and of how much, None where nobody knows."""

MOST_BYTES = 256 << 20
"""Of a text or an image: no real one is larger, and more would not fit into memory when parsed."""
MOST_SETTINGS_BYTES = 16 << 20
"""Of a file of names and values: settings, cameras, certificates."""
MOST_WEIGHTS_BYTES = 1 << 30
"""Of a file of weights; VGG-16 with all its layers has half as much."""
MOST_ONNX_BYTES = 2 << 30
"""Of a network as an ONNX file, whose format allows no more; larger tensors lie beside it."""

_MOST_TIMES, _FREE_BYTES = 10, 64 << 20
"""An archive may unpack to so many times its size, or to so many bytes."""

_CHUNK_BYTES = 1 << 20

# UTF-32 first, whose mark in little endian begins with that of UTF-16.
_MARKS = (
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)


def cache_folder() -> Path:
    """Return the folder of both commands: loopclose under $XDG_CACHE_HOME or ~/.cache.

    Raises:
        LoopcloseError: the user has no home, and the variable is not set.
    """
    root = os.environ.get("XDG_CACHE_HOME", "")
    if Path(root).is_absolute():
        return Path(root) / "loopclose"
    try:
        return Path.home() / ".cache" / "loopclose"
    except RuntimeError as error:
        raise LoopcloseError(
            "you have no home folder to keep downloads in; set XDG_CACHE_HOME to a folder"
        ) from error


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


def is_file(path: Path) -> bool:
    """Return whether there is such a file; there is none whose name no file can have."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name too long, or not of this system's characters
        return False


def is_folder(path: Path) -> bool:
    """Return whether there is such a folder; there is none whose name no folder can have."""
    try:
        return path.is_dir()
    except (OSError, ValueError):
        return False


def check_file(
    file: Path,
    most_bytes: int = MOST_BYTES,
    *,
    what: str | None = None,
    kind: type[LoopcloseError] = LoopcloseError,
) -> None:
    """Refuse what is no plain file, such as a pipe, on which reading could wait for ever.

    Args:
        file: what is to be read next.
        most_bytes: it may hold.
        what: it is called in messages; default: its name.
        kind: of the error raised.

    Raises:
        LoopcloseError: it is missing, no plain file, or too large.
    """
    what = what or file.name
    try:
        status = file.stat()
    except OSError as error:
        raise kind(f"cannot read {what}: {error.strerror}: {file}") from error
    except ValueError as error:  # a NUL in it, or half a character
        raise kind(f"cannot read {what}: no file can have this name: {file}") from error
    if stat.S_ISDIR(status.st_mode):
        raise kind(f"cannot read {what}: Is a directory: {file}")
    if not stat.S_ISREG(status.st_mode):
        raise kind(
            f"cannot read {what}: it is a pipe, a device or a socket; give a plain file: {file}"
        )
    if status.st_size > most_bytes:
        raise kind(_too_large(what, most_bytes, file))


def read_bytes(
    file: Path,
    most_bytes: int = MOST_BYTES,
    *,
    what: str | None = None,
    kind: type[LoopcloseError] = LoopcloseError,
) -> bytes:
    """Return what a plain file holds; the arguments are those of `check_file`.

    Raises:
        LoopcloseError: it is missing, no plain file, too large, or cannot be read.
    """
    check_file(file, most_bytes, what=what, kind=kind)
    what = what or file.name
    try:
        with file.open("rb") as stream:
            size = os.fstat(stream.fileno()).st_size
            content = stream.read(size + 1)
            # What the system makes up as it is read says that it has no size.
            while size < len(content) <= most_bytes and (more := stream.read(_CHUNK_BYTES)):
                content += more
    except OSError as error:
        raise kind(f"cannot read {what}: {error.strerror}: {file}") from error
    if len(content) > most_bytes:
        raise kind(_too_large(what, most_bytes, file))
    return content


def _too_large(what: str, most_bytes: int, file: Path) -> str:
    return f"cannot read {what}: it is larger than {most_bytes >> 20} MB: {file}"


def read_text(
    file: Path,
    most_bytes: int = MOST_BYTES,
    *,
    what: str | None = None,
    kind: type[LoopcloseError] = LoopcloseError,
) -> str:
    """Return what a file in UTF-8, or marked as UTF-16 or UTF-32, holds, without its mark.

    The arguments are those of `check_file`.

    Raises:
        LoopcloseError: it cannot be read or is not text.
    """
    content = read_bytes(file, most_bytes, what=what, kind=kind)
    encoding = next((name for mark, name in _MARKS if content.startswith(mark)), "utf-8")
    what = what or file.name
    try:
        text = content.decode(encoding)
    except UnicodeDecodeError as error:
        raise kind(f"{what} is not text in UTF-8; save it as such: {file}") from error
    if "\0" in text:
        line = text[: text.index("\0")].count("\n") + 1
        raise kind(f"{what} is not text: line {line} holds a NUL: {file}")
    return text


def read_toml(
    file: Path, *, what: str | None = None, kind: type[LoopcloseError] = LoopcloseError
) -> dict[str, Any]:
    """Return the tables of a TOML file; the arguments are those of `check_file`.

    Raises:
        LoopcloseError: it cannot be read or is not TOML.
    """
    text = read_text(file, MOST_SETTINGS_BYTES, what=what, kind=kind)
    problem = f"{what or file.name} is not valid TOML"
    tables: dict[str, Any] = _parsed(tomllib.loads, text, problem, file, kind)
    return tables


def read_json(
    file: Path, *, what: str | None = None, kind: type[LoopcloseError] = LoopcloseError
) -> Any:
    """Return what a JSON file holds; the arguments are those of `check_file`.

    Raises:
        LoopcloseError: it cannot be read or is not JSON.
    """
    text = read_text(file, MOST_SETTINGS_BYTES, what=what, kind=kind)
    return _parsed(json.loads, text, f"{what or file.name} is not valid JSON", file, kind)


def _parsed(
    parse: Callable[[str], Any], text: str, problem: str, file: Path, kind: type[LoopcloseError]
) -> Any:
    try:
        return parse(text)
    except ValueError as error:  # also of a number of thousands of digits
        raise kind(f"{problem}: {error}: {file}") from error
    except RecursionError as error:
        raise kind(f"{problem}: it is nested too deeply: {file}") from error


def array_of(content: bytes) -> NDArray[Any]:
    """Return the array of numbers that the content of a .npy file is, whatever it claims to be.

    Raises:
        ValueError: it is none, of Python's objects, or not of the size that it says.
    """
    stream = io.BytesIO(content)
    try:
        major, _ = npy.read_magic(stream)
        read = (
            np.lib.format.read_array_header_1_0
            if major == 1
            else np.lib.format.read_array_header_2_0
        )
        shape, is_fortran, kind = read(stream)
        numbers = np.frombuffer(content, kind, offset=stream.tell())
        return numbers.reshape(shape, order="F" if is_fortran else "C").copy()
    except Exception as error:  # the header is Python, and may say anything
        raise ValueError("no array, or cut off") from error


def arrays_of(content: bytes) -> dict[str, NDArray[Any]]:
    """Return the arrays of numbers that the content of a .npz file holds, by name.

    Raises:
        ValueError: it is none, or unpacks to far more than itself.
    """
    try:
        check_zip(content)
    except zipfile.BadZipFile as error:
        raise ValueError("not an archive of arrays") from error
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return {
                entry.filename.removesuffix(".npy"): array_of(archive.read(entry))
                for entry in archive.infolist()
            }
    except Exception as error:  # zipfile has many, for what it does not know, too
        raise ValueError("not an archive of arrays") from error


def check_zip(content: bytes) -> None:
    """Refuse a ZIP archive that unpacks to far more than weights do, which hardly compress.

    What is no such archive passes.

    Raises:
        ValueError: it does, or its table is damaged.
    """
    if not content.startswith(b"PK"):
        return
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        unpacked = sum(entry.file_size for entry in archive.infolist())
    if unpacked > max(_MOST_TIMES * len(content), _FREE_BYTES):
        raise ValueError("it unpacks to far more than its own size")
