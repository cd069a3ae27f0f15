# SPDX-License-Identifier: Apache-2.0
"""Damaged files for every reader; see `python -m benchmarks.fuzz --help`."""
