# SPDX-License-Identifier: Apache-2.0
"""`placerec check`: does a recognizer keep to the protocol?"""

from collections import Counter
from collections.abc import Iterator
from itertools import groupby
from math import isfinite
from typing import Annotated

import tyro

from placerec.commands.console import say
from placerec.commands.data import RECOGNIZER
from placerec.conformance.examination import CHECKS, SECTIONS, Examination
from placerec.conformance.made_images import PLACES
from placerec.conformance.subject import Finding, Verdict
from placerec.recognizer import load

_DOES_NOT_CONFORM = 1
_IN_A_MAP = 10_000
_WIDTH = max(len(check.name) for check in CHECKS)


def check(
    recognizer: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar=RECOGNIZER)],
    /,
) -> int:
    """Tell what a recognizer does right and wrong, and what it costs.

    It is tried out on generated pictures, within a minute: what it returns; what it does beside
    that; whether an image gives the same bytes again, after others, in threads and elsewhere;
    whether pairs are compared on their own; whether places are found again, by all of the image;
    and whether its min_similarity is one that views of a place reach and unlike pictures do not.
    Each line has what was measured, and where it fails what to do. A warning is no failure.

    Args:
        recognizer: an installed name, package.module:ClassName, trained weights or an ONNX file.
    """
    examination = Examination(load(recognizer), recognizer)
    say(f"{recognizer}, tried out on generated pictures of {PLACES} places")
    findings = []
    for section, checks in SECTIONS.items():
        found = [examination.find(check) for check in checks]
        say("\n".join((f"\n{section}", *_rows(found))))
        findings += found
    for line in _costs(examination):
        say(line)
    counts = Counter(finding.verdict for finding in findings)
    failed = counts[Verdict.FAILED]
    what = f"{failed} of {len(findings)} checks failed" if failed else "all checks passed"
    asides = {"doubtful": counts[Verdict.DOUBTFUL], "not tried": counts[Verdict.NOT_TRIED]}
    say("\n" + ", ".join([what, *(f"{n} {title}" for title, n in asides.items() if n)]))
    return _DOES_NOT_CONFORM if failed else 0


def _rows(findings: list[Finding]) -> Iterator[str]:
    """Write findings as rows, those in a row that wait for the same to be mended as one."""
    for (verdict, measured), group in groupby(findings, lambda one: (one.verdict, one.measured)):
        alike = list(group)
        if verdict is Verdict.NOT_TRIED and len(alike) > 1:
            yield _row(verdict, f"{len(alike)} more", measured)
            continue
        for finding in alike:
            yield _row(verdict, finding.check.name, measured)
            if verdict in (Verdict.FAILED, Verdict.DOUBTFUL):
                yield _row("", "", f"-> {finding.check.remedy}")


def _row(verdict: str, name: str, measured: str) -> str:
    return f"  {verdict:<4}  {name:<{_WIDTH}}  {measured}"


def _costs(examination: Examination) -> Iterator[str]:
    cost, own_mb = examination.cost(), examination.own_mb()
    if cost:
        kb = cost.embedding_bytes / 1e3
        yield _row("", "to embed 640x480", f"{cost.embed_ms:.1f} ms")
        yield _row("", f"to compare with {_IN_A_MAP:,}", f"{cost.compare_ms * _IN_A_MAP:.1f} ms")
        yield _row(
            "", f"to keep {_IN_A_MAP:,}", f"{kb * _IN_A_MAP / 1e3:,.1f} MB, {kb:.1f} kB each"
        )
    if isfinite(own_mb):
        yield _row("", "to load and to work", f"{own_mb:.0f} MB, its libraries included")
