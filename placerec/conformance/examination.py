# SPDX-License-Identifier: Apache-2.0
"""All checks of one recognizer."""

import io
from contextlib import redirect_stdout
from dataclasses import dataclass
from time import perf_counter

import numpy as np

from placerec.conformance import (
    answer,
    comparison,
    recognition,
    repetition,
    side_effects,
    threshold,
)
from placerec.conformance.made_images import places
from placerec.conformance.subject import Check, Finding, NamelessError, Outcome, Subject, Verdict
from placerec.evaluation.measurement import Cost, measure_cost
from placerec.recognizer import PlaceRecognizer

SECTIONS = {
    "what it returns": answer.CHECKS,
    "what it does beside that": side_effects.CHECKS,
    "the same image gives the same bytes": repetition.CHECKS,
    "embeddings are compared": comparison.CHECKS,
    "places are found again": recognition.CHECKS,
    "min_similarity tells places apart": threshold.CHECKS,
    "what it costs on this machine": repetition.COSTS,
}
CHECKS: tuple[Check, ...] = tuple(check for checks in SECTIONS.values() for check in checks)


@dataclass(frozen=True)
class Report:
    """What a recognizer does right and wrong."""

    findings: tuple[Finding, ...]

    @property
    def passed(self) -> bool:
        """Whether the recognizer does all that it must."""
        return not any(finding.failed for finding in self.findings)

    def __str__(self) -> str:
        wrong = [finding for finding in self.findings if finding.failed]
        return "\n".join(f"{finding.check.name}: {finding.measured}" for finding in wrong)


def check(recognizer: PlaceRecognizer, name: str | None = None) -> Report:
    """Try a recognizer out on generated pictures; the name is what `load` makes another by."""
    examination = Examination(recognizer, name)
    return Report(tuple(examination.find(check) for check in CHECKS))


class Examination:
    """The checks of one recognizer, in any order, each made once and after those it needs."""

    def __init__(self, recognizer: PlaceRecognizer, name: str | None = None) -> None:
        """Look at a recognizer; without the name that `load` knows it by no other can be made."""
        self._subject = Subject(recognizer, name)
        self._findings: dict[str, Finding] = {}

    def find(self, check: Check) -> Finding:
        """Return what a check finds; a recognizer that raises has failed it."""
        if check.name not in self._findings:
            passed, measured = self._outcome(check)
            if not isinstance(passed, Verdict):
                passed = Verdict.PASSED if passed else Verdict.FAILED
            self._findings[check.name] = Finding(check, passed, measured)
        return self._findings[check.name]

    def cost(self) -> Cost | None:
        """Return what an image costs on this machine, None where it cannot be measured."""
        if self.find(comparison.similarities).verdict is not Verdict.PASSED:
            return None
        images, ticks = places(), [perf_counter()]
        with redirect_stdout(io.StringIO()):
            for image in images:
                self._subject.recognizer.embed(image)
                ticks.append(perf_counter())
        embeddings = np.stack(self._subject.embeddings)
        return measure_cost(embeddings, np.diff(ticks), self._subject.comparer)

    def own_mb(self) -> float:
        """Return the memory that one of its kind took in a process of its own, NaN if unknown."""
        is_known = self.find(repetition.fresh_process).verdict is Verdict.PASSED
        return self._subject.fresh_run.own_mb if is_known else float("nan")

    def _obstacle(self, check: Check) -> str | None:
        """Return the name of the failed check for which this one would say nothing new."""
        for needed in check.needs:
            obstacle = needed.name if self.find(needed).failed else self._obstacle(needed)
            if obstacle:
                return obstacle
        return None

    def _outcome(self, check: Check) -> Outcome:
        if obstacle := self._obstacle(check):
            return Verdict.NOT_TRIED, f"first mend {obstacle!r}"
        with redirect_stdout(io.StringIO()):  # what it prints has a check of its own
            try:
                return check.run(self._subject)
            except NamelessError as reason:
                return Verdict.NOT_TRIED, f"{reason}"
            except Exception as error:
                return False, self._subject.explain(error)
