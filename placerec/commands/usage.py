# SPDX-License-Identifier: Apache-2.0
"""What both commands answer to a command line: --version, help of one screen, and one-line errors.

tyro makes the help, of types and docstrings; --help-all shows it as it is.
"""

import io
import re
import shutil
import sys
import textwrap
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stderr, redirect_stdout
from importlib.metadata import version
from typing import TypeVar

import tyro
from pydantic import ValidationError

from placerec.commands.console import put
from placerec.errors import RecognizerError

HELP_ALL = "--help-all"
_HELP, _VERSION, _COMPLETION = "--help", "--version", "--completion"
_SHELLS = ("bash", "zsh", "fish", "tcsh")
_OF_BOTH = (
    (HELP_ALL, "show all settings, and more about what is above"),
    ("-q, --quiet", "print warnings and errors only"),
    ("-v, --verbose", "print what is logged, too"),
    (_VERSION, "show the version and exit"),
    (f"{_COMPLETION} SHELL", f"print what completes flags in {', '.join(_SHELLS)}"),
)
# Written to what is no terminal, tyro's text has no frames and no colours.
_SECTION = re.compile(r"^ (\S.*?) *\n -+ *\n", re.MULTILINE)
_RULE = re.compile(r"^ +-+ *$", re.MULTILINE)
_ARGUMENT = re.compile(r"^  (\S.*?)(?:  +(.*?))?$((?:\n   .*)*)", re.MULTILINE)
_ASKED = ("positional arguments", "options")
T = TypeVar("T")


def answered(
    prog: str,
    typed: Sequence[str],
    read: Callable[[list[str]], T],
    sections: Mapping[str, str] | None = None,
) -> T:
    """Return what `read`, which calls tyro, makes of a command line.

    Exits with code 0 after what was typed asks for: version, help, a script of completions.

    Args:
        prog: the command's name.
        typed: what was typed after it.
        read: takes what is left of it to tyro.
        sections: before the dot of a flag, by the name of the class of its settings.

    Raises:
        RecognizerError: something is wrong with what was typed: one line that names it.
    """
    arguments, is_all = list(typed), HELP_ALL in typed
    if _VERSION in arguments:
        put(f"{prog} {version('loopclose')}")
        sys.exit(0)
    if arguments[:1] == [_COMPLETION]:
        if arguments[1:] not in [[shell] for shell in _SHELLS]:
            raise RecognizerError(f"{_COMPLETION} needs the name of a shell: {', '.join(_SHELLS)}")
        arguments[0] = "--tyro-print-completion"
    asked = [_HELP if each in ("-h", HELP_ALL) else each for each in arguments]
    out, err = io.StringIO(), io.StringIO()
    try:
        with redirect_stdout(out), redirect_stderr(err):
            return read(asked)
    except SystemExit as ended:
        if not ended.code:
            put(_help(out.getvalue(), is_all) if _HELP in asked else out.getvalue())
            raise
        wrong = _validation_error(ended)
        said = _describe(wrong, sections or {}) if wrong else _said(err.getvalue())
        raise RecognizerError(f"{said}; see {HELP_ALL}") from ended


def parsed(
    kind: type[T],
    prog: str,
    description: str,
    typed: Sequence[str],
    default: T | None = None,
    sections: Mapping[str, str] | None = None,
) -> T:
    """Return a command line as a dataclass, whose docstrings are the help of its flags.

    The default has the values of what is not typed, unless they are those of the class. The rest is
    as in `answered`.
    """
    values = tyro.MISSING_NONPROP if default is None else default

    def read(left: list[str]) -> T:
        return tyro.cli(kind, prog=prog, description=description, args=left, default=values)

    return answered(prog, typed, read, sections)


def as_typed(message: str, names: Sequence[str]) -> str:
    """Return a message that begins with `name = ` with it written as the flag that was typed."""
    name, equals, rest = message.partition(" = ")
    return f"{_flag(name)} {rest}" if equals and name in names else message


def _flag(name: str) -> str:
    return f"--{name.replace('_', '-')}"


def _help(text: str, is_all: bool) -> str:
    """Return tyro's help as wide as the terminal: all of it, or as much as goes on a screen."""
    head, *sections = _SECTION.split(text)
    paragraphs = re.sub(r"\n{3,}", "\n\n", head).strip().splitlines()
    lines = [line for each in paragraphs for line in (_filled(each) or [""])]
    if is_all:
        rest = text[len(head) :].rstrip()
        return "\n".join((*lines, "", rest, "", " of all commands", *_rows(_OF_BOTH)))
    bodies = [b for title, b in zip(sections[::2], sections[1::2], strict=True) if title in _ASKED]
    asked = [
        (name, _first_sentence(f"{told}{more}"))
        for body in bodies
        for name, told, more in _ARGUMENT.findall(body)
    ]
    return "\n".join((*lines, "", *_rows((*asked, *_OF_BOTH))))


def _rows(rows: Sequence[tuple[str, str]]) -> list[str]:
    column = min(max(len(name) for name, _ in rows) + 4, 24)
    lines = []
    for name, told in rows:
        if len(name) + 4 > column:
            lines.append(f"  {name}")
            name = ""
        lines += _filled(told, f"  {name:<{column - 2}}", " " * column)
    return lines


def _filled(text: str, first: str = "", next_: str = "") -> list[str]:
    if text[:1].isspace():
        return [text]  # an example
    width = shutil.get_terminal_size().columns
    return textwrap.wrap(text, width, initial_indent=first, subsequent_indent=next_)


def _first_sentence(told: str) -> str:
    text = " ".join(told.split())
    default = re.search(r" \(default: (?!None).+\)$", text)
    sentence = re.split(r"[.;:](?: |$)| \((?:required|default:|at least one)", text)[0]
    return sentence + (default[0] if default else "")


def _validation_error(error: BaseException | None) -> ValidationError | None:
    """Return what refused a value, if it is what an exit comes from."""
    while error:
        if isinstance(error, ValidationError):
            return error
        error = error.__cause__ or error.__context__
    return None


def _describe(error: ValidationError, sections: Mapping[str, str]) -> str:
    """Return what is wrong with the first wrong value, in one line that begins with its flag."""
    first = error.errors()[0]
    of_the_same = [each for each in error.errors() if each["loc"][0] == first["loc"][0]]
    section, name = sections.get(error.title), str(first["loc"][0])
    value = first["input"]
    typed = " ".join(map(str, value)) if isinstance(value, tuple) else value
    messages = (each["msg"].removeprefix("Value error, ") for each in of_the_same)
    whys = " or ".join(f"{each[:1].lower()}{each[1:]}" for each in messages)
    flag = _flag(f"{section}.{name}" if section else name)
    return f"{flag} {typed}: {whys}"


def _said(complaint: str) -> str:
    """Return what tyro says between a title and rules as one line, and which flags it proposes."""
    _, said, *hints = (part.strip() for part in _RULE.split(complaint))
    proposed = [
        flag
        for hint in hints
        if hint.startswith("Perhaps")
        for flag in re.findall(r"^ +(--[\w.-]+)", hint, re.MULTILINE)
    ]
    said = " ".join(re.split(r"\n *\n", said)[0].split()).rstrip(".")
    return f"{said}; perhaps you meant {' or '.join(proposed)}" if proposed else said
