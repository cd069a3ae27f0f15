# SPDX-License-Identifier: Apache-2.0
"""Checks of what embedding an image does beside returning its embedding."""

import io
import random
import sys
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from dataclasses import dataclass
from typing import Any

import numpy as np

from placerec.conformance.answer import finite, returns_numbers
from placerec.conformance.made_images import places
from placerec.conformance.subject import Outcome, Subject, as_check, program_settings

_DRAWS = 4


@as_check("leaves the image alone", "it is used after you: work on image.copy()", returns_numbers)
def leaves_image(subject: Subject) -> Outcome:
    """It changes no pixel of the image that it is given."""
    image = places()[0]
    before = image.copy()
    subject.recognizer.embed(image)
    changed = int((before != image).sum())
    return changed == 0, f"{changed} values changed"


@as_check(
    "gives its answer away",
    "return embedding.copy(): others keep it, and your next answer overwrites it",
    finite,
)
def gives_away(subject: Subject) -> Outcome:
    """What it returned stays as it was when it returned it."""
    first, *others = places()[:3]
    answer = np.asarray(subject.recognizer.embed(first))
    before = answer.copy()
    for image in others:
        subject.recognizer.embed(image)
    changed = int((answer != before).sum())
    return changed == 0, f"{changed} of {answer.size} values changed with the next image"


@as_check("prints nothing", "stdout belongs to the commands: use logging", returns_numbers)
def _prints_nothing(subject: Subject) -> Outcome:
    with redirect_stdout(io.StringIO()) as printed:
        subject.embed(places()[0])
    text = printed.getvalue()
    return not text, f"{len(text)} characters" + (f": {text[:40]!r}" if text else "")


@dataclass(frozen=True)
class _Generator:
    """Random numbers that all of a program draws from."""

    name: str
    read: Callable[[], Any]
    write: Callable[[Any], object]
    draw: Callable[[], object]


def _generators() -> Iterator[_Generator]:
    module: Any = np.random  # its type stubs leave the function out
    bits = module.get_bit_generator()
    yield _Generator(
        "numpy.random",
        lambda: bits.state,
        lambda state: setattr(bits, "state", state),
        lambda: bits.random_raw(_DRAWS).tolist(),
    )
    yield _Generator(
        "random", random.getstate, random.setstate, lambda: random.sample(range(1 << 30), _DRAWS)
    )
    torch: Any = sys.modules.get("torch")
    if torch:
        read, write = torch.get_rng_state, torch.set_rng_state
        yield _Generator("torch", read, write, lambda: torch.rand(_DRAWS).tolist())


@as_check(
    "leaves random numbers alone",
    "draw from your own np.random.default_rng(0), torch.Generator(): seed() is everybody's",
    returns_numbers,
)
def _leaves_random_numbers(subject: Subject) -> Outcome:
    changed = []
    for generator in _generators():
        found = generator.read()
        try:
            generator.draw()  # an earlier image may have left it where this one will
            state = generator.read()
            expected = generator.draw()
            generator.write(state)
            subject.embed(places()[0])
            if generator.draw() != expected:
                changed.append(generator.name)
        finally:
            generator.write(found)
    if changed:
        return False, f"the next random numbers of {', '.join(changed)} are others"
    return True, f"those of {', '.join(generator.name for generator in _generators())}"


@as_check(
    "leaves the program's settings",
    "set them back: `with np.errstate(...)`, `with torch.inference_mode()`; use full paths",
    returns_numbers,
)
def leaves_settings(subject: Subject) -> Outcome:
    """What all of a program shares is as before the first image."""
    subject.embed(places()[0])
    now = program_settings()
    before = subject.settings_before
    changed = [f"{key} is now {now[key]}" for key in before if now[key] != before[key]]
    return not changed, ", ".join(changed or before)


CHECKS = (
    leaves_image,
    gives_away,
    _prints_nothing,
    _leaves_random_numbers,
    leaves_settings,
)
