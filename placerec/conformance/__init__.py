# SPDX-License-Identifier: Apache-2.0
"""Whether a recognizer keeps to the protocol: `placerec check`, or a test of pytest per check."""

from placerec.conformance.examination import CHECKS, SECTIONS, Examination, Report, check
from placerec.conformance.made_images import PLACES
from placerec.conformance.subject import Check, Finding, Verdict

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
