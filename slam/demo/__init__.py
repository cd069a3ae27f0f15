# SPDX-License-Identifier: Apache-2.0
"""Furnished rooms made from a seed, for sequences with exact ground truth."""
