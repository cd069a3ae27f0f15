# SPDX-License-Identifier: Apache-2.0
"""Whether a recognizer keeps to the protocol: `placerec check`, or a test of pytest per check."""

from placerec.conformance.examination import check

__all__ = ["check"]
