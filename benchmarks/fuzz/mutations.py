# SPDX-License-Identifier: Apache-2.0
"""Damage to good files: what transfers, editors, other tools and ill will make of them."""

import random
from collections.abc import Callable

WORDS = (
    *(b"nan", b"-inf", b"1e308", b"-1", b"0", b"1e-320", b"0x10", b"null", b"true", b"{}", b"[]"),
    *(b"18446744073709551616", b"-9223372036854775809", b"9" * 5000, b"1" + b"0" * 400),
    *(b"[" * 5000, b'{"a":' * 3000, b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"\x1b[31m", b"\r", b"\n"),
    *(b"../../etc/passwd", b"/dev/zero", b"x" * 300, "\u202e\ud7ff\U0001f600".encode(), b'"', b"="),
    *(b"=1+1", b"a" * 200_000, b",", b" ", b"#", b"\xc3\xa9", b"\\u0000", b"\\ud800"),
)
_MOST_BYTES = 4 << 20
_NUMBERS = [
    n.to_bytes(size, order)
    for size in (1, 2, 4, 8)
    for order in ("little", "big")
    for n in (0, 1, 2 ** (8 * size) - 1, 2 ** (8 * size - 1), 2 ** (8 * size - 1) - 1)
]


def mutated(good: bytes, is_text: bool, seed: int) -> bytes:
    """Return a file that a few things happened to; the same seed, the same damage."""
    chance = random.Random(seed)
    content = good
    for _ in range(chance.choice((1, 1, 2, 3, 6))):
        kinds = _TEXT if is_text and chance.random() < 0.8 else _BYTES
        content = chance.choice(kinds)(content, chance)[:_MOST_BYTES]
    return content


def _change_bits(content: bytes, chance: random.Random) -> bytes:
    changed = bytearray(content)
    for _ in range(chance.choice((1, 3, 30))):
        if changed:
            changed[chance.randrange(len(changed))] ^= 1 << chance.randrange(8)
    return bytes(changed)


def _put_number(content: bytes, chance: random.Random) -> bytes:
    number, at = chance.choice(_NUMBERS), chance.randrange(len(content) + 1)
    return content[:at] + number + content[at + len(number) :]


def _cut(content: bytes, chance: random.Random) -> bytes:
    return content[: chance.randrange(len(content) + 1)]


def _drop(content: bytes, chance: random.Random) -> bytes:
    start, stop = sorted(chance.randrange(len(content) + 1) for _ in range(2))
    return content[:start] + content[stop:]


def _repeat(content: bytes, chance: random.Random) -> bytes:
    start, stop = sorted(chance.randrange(len(content) + 1) for _ in range(2))
    return content[:stop] + content[start:stop] * chance.choice((1, 3, 50)) + content[stop:]


def _put_word(content: bytes, chance: random.Random) -> bytes:
    at = chance.randrange(len(content) + 1)
    return content[:at] + chance.choice(WORDS) + content[at:]


def _replace_word(content: bytes, chance: random.Random) -> bytes:
    words = content.split(b" ") if b" " in content else content.split(b",")
    words[chance.randrange(len(words))] = chance.choice(WORDS)
    return (b" " if b" " in content else b",").join(words)


def _replace_number(content: bytes, chance: random.Random) -> bytes:
    starts = [i for i in range(len(content)) if content[i : i + 1].isdigit()]
    if not starts:
        return content
    start = chance.choice(starts)
    end = start
    while content[end : end + 1].isdigit() or content[end : end + 1] == b".":
        end += 1
    return content[:start] + chance.choice(WORDS) + content[end:]


def _shuffle_lines(content: bytes, chance: random.Random) -> bytes:
    lines = content.splitlines(keepends=True)
    chance.shuffle(lines)
    return b"".join(lines)


def _encode_anew(content: bytes, chance: random.Random) -> bytes:
    text = content.decode("latin-1")
    return text.encode(chance.choice(("utf-16", "utf-16-le", "utf-8-sig", "utf-32")))


_Mutation = Callable[[bytes, random.Random], bytes]
_BYTES: tuple[_Mutation, ...] = (_change_bits, _put_number, _cut, _drop, _repeat)
_TEXT: tuple[_Mutation, ...] = (
    _put_word,
    _replace_word,
    _replace_number,
    _replace_number,
    _shuffle_lines,
    _encode_anew,
    _cut,
    _repeat,
)
