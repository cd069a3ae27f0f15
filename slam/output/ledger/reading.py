# SPDX-License-Identifier: Apache-2.0
"""Reads a ledger back, line by line."""

import json
from contextlib import suppress
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from placerec.files import is_file, is_folder, read_text
from slam.output.claimed_folder import UNFINISHED
from slam.output.ledger.records import VERSION, LoopRecord
from slam.types import SlamError

_OLDEST = 1
_LINE = TypeAdapter(LoopRecord)


def read_ledger(path: Path | str) -> tuple[LoopRecord, ...]:
    """Read back the loop decisions of a run, from its loops.jsonl or its folder.

    Of a run that was killed the folder has what was decided until then, before the pose graph had
    its say; a last line that was torn is left out.

    Raises:
        SlamError: the file cannot be read, a line is not a loop record, or it is of another version
            of the schema; names the line.
    """
    path = Path(path)
    if is_folder(path):
        left, name = path / UNFINISHED / "loops.jsonl", "loops.jsonl"
        path = left if is_file(left) and not is_file(path / name) else path / name
    lines = read_text(path, what="the loop ledger", kind=SlamError).split("\n")
    torn = lines.pop()  # nothing, after a whole line
    records = [_read(line, f"line {n} of the loop ledger", path) for n, line in enumerate(lines, 1)]
    with suppress(ValidationError):
        records += [_LINE.validate_json(torn)] if torn else []
    return tuple(records)


def _read(line: str, place: str, path: Path) -> LoopRecord:
    try:
        return _LINE.validate_json(line)
    except ValidationError as error:
        if (told := _of_another_version(line)) is not None:
            raise SlamError(f"{place} {told}: {path}") from error
        first = error.errors()[0]
        name = ".".join(str(part) for part in first["loc"]) or "the line"
        raise SlamError(f"{place}: {name}: {first['msg']}: {path}") from error


def _of_another_version(line: str) -> str | None:
    """Return what to say of a line of another version of the schema, None if it is none."""
    try:
        content = json.loads(line)
        version = content.get("version", 0 if "query_id" in content else VERSION)
        is_newer, is_older = version > VERSION, version < _OLDEST
    except (ValueError, TypeError, AttributeError, RecursionError):
        return None
    if is_newer:
        return f"is of schema {version}, and this reads {VERSION}: update loopclose"
    return f"was written before schema {_OLDEST}: run again" if is_older else None
