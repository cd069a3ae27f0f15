# SPDX-License-Identifier: Apache-2.0
"""What networks are computed on: the CPU, unless $LOOPCLOSE_DEVICE names something else."""

import os
import re

from placerec.errors import RecognizerError

VARIABLE = "LOOPCLOSE_DEVICE"
CPU = "cpu"


def device_asked_for() -> str:
    """Return "cpu", or what is asked for instead, with its number where there are several.

    On the CPU, one thread and one image at a time give the same bytes on every machine of a kind;
    elsewhere images go in batches, and the last digits may differ.

    Raises:
        RecognizerError: the variable holds no such name.
    """
    name = os.environ.get(VARIABLE, "").strip().lower() or CPU
    if not re.fullmatch(r"(?!cpu:)[a-z][a-z0-9]*(:\d{1,3})?", name):
        raise RecognizerError(
            f"{VARIABLE}={os.environ[VARIABLE]!r} is no device; name one like cpu, cuda or cuda:1"
        )
    return name


def on_another() -> str:
    """Return where networks are computed as it is told after their names: "" on the CPU."""
    device = device_asked_for()
    return "" if device == CPU else f" on {device}"


def images_at_once() -> int:
    """Return how many images networks are to take at once where all are there: on the CPU one."""
    return 32 if on_another() else 1


def no_such_device(name: str, of: str, why: str) -> RecognizerError:
    """Return the error that what runs a network here, torch or onnxruntime, has no such device."""
    return RecognizerError(f"{VARIABLE}={name}: {of} cannot use it: {why}")
