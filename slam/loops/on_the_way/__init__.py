# SPDX-License-Identifier: Apache-2.0
"""Corrections while a run goes on: when, of what, and where they are solved."""
