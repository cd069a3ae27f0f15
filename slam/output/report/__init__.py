# SPDX-License-Identifier: Apache-2.0
"""One self-contained web page that shows what every loop decision did to the drift."""

from slam.output.report.page import write_report

__all__ = ["write_report"]
