# SPDX-License-Identifier: Apache-2.0
"""What is looked for in a recognizer, and what is found."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from placerec.conformance.subject import Subject


class Verdict(StrEnum):
    """Whether a recognizer does what a check asks for; the values are what people read."""

    PASSED = "ok"
    FAILED = "FAIL"
    NOT_TRIED = "--"


@dataclass(frozen=True)
class Outcome:
    """A verdict and, in one line, the value that led to it."""

    verdict: Verdict
    measured: str


@dataclass(frozen=True)
class Check:
    """One thing that a recognizer must do.

    Attributes:
        name: what it must do, in a few words.
        run: tries it out; where that raises, the check has failed.
        remedy: what the recognizer's author can do where it fails, in one line.
        needs: the names of earlier checks without which this one would say nothing new.
    """

    name: str
    run: Callable[[Subject], Outcome]
    remedy: str
    needs: tuple[str, ...] = ()


@dataclass(frozen=True)
class Finding:
    """A check that was made, or not tried, and its outcome."""

    check: Check
    verdict: Verdict
    measured: str

    @property
    def failed(self) -> bool:
        """Whether the recognizer does not do what it must."""
        return self.verdict is Verdict.FAILED


def judged(is_good: bool, measured: str) -> Outcome:
    """Return the outcome of a check that was made."""
    return Outcome(Verdict.PASSED if is_good else Verdict.FAILED, measured)


def not_tried(why: str) -> Outcome:
    """Return the outcome of a check that could not be made, or need not be."""
    return Outcome(Verdict.NOT_TRIED, why)
