# SPDX-License-Identifier: Apache-2.0
"""`placerec check`: does a recognizer keep to the protocol?"""

from math import isfinite
from typing import Annotated

import tyro

from placerec.commands.data import RECOGNIZER
from placerec.conformance import CHECKS, SECTIONS, Examination, Finding, Verdict
from placerec.recognizer import load

DOES_NOT_CONFORM = 1
PLACES = 10_000
WIDTH = max(len(check.name) for check in CHECKS)


def check(
    recognizer: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar=RECOGNIZER)],
    /,
) -> int:
    """Tell what a recognizer does right and wrong, and what to do about it.

    Args:
        recognizer: an installed name, package.module:ClassName, or trained weights.
    """
    examination = Examination(load(recognizer), recognizer)
    findings = []
    for section, checks in SECTIONS.items():
        print(f"\n{section}")
        for one in checks:
            findings.append(examination.find(one))
            print(_row(findings[-1]), flush=True)
    _print_costs(examination)
    print(f"\n{recognizer}: {_summary(findings)}")
    return DOES_NOT_CONFORM if any(finding.failed for finding in findings) else 0


def _row(finding: Finding) -> str:
    row = f"  {finding.verdict:<4}  {finding.check.name:<{WIDTH}}  {finding.measured}"
    return f"{row}\n{'':<8}-> {finding.check.remedy}" if finding.failed else row


def _print_costs(examination: Examination) -> None:
    cost, own_mb = examination.cost(), examination.own_mb()
    if cost is None:
        return
    kb = cost.embedding_bytes / 1e3
    print("\nwhat it costs on this machine")
    print(f"  {cost.embed_ms:.1f} ms per 640x480 image")
    print(f"  {1e3 * cost.compare_ms:.3g} us to compare two places")
    print(f"  {kb:.1f} kB per place, {kb * PLACES / 1e3:.0f} MB for {PLACES:,} of them")
    if isfinite(own_mb):
        print(f"  {own_mb:.0f} MB to load and to work, libraries included")


def _summary(findings: list[Finding]) -> str:
    counts = {one: sum(finding.verdict is one for finding in findings) for one in Verdict}
    if not counts[Verdict.FAILED]:
        return f"all {counts[Verdict.PASSED]} checks passed"
    untried = counts[Verdict.NOT_TRIED]
    also = f", {untried} not tried" if untried else ""
    return f"{counts[Verdict.FAILED]} of {len(findings)} checks failed{also}"
