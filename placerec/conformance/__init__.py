# SPDX-License-Identifier: Apache-2.0
"""Whether a recognizer keeps to the protocol: `placerec check`, or a test of pytest per check."""

from placerec.conformance.examination import CHECKS, SECTIONS, Examination, Report, check
from placerec.conformance.finding import Check, Finding, Verdict
from placerec.conformance.pictures import PLACES

__all__ = [
    "CHECKS",
    "PLACES",
    "SECTIONS",
    "Check",
    "Examination",
    "Finding",
    "Report",
    "Verdict",
    "check",
]
