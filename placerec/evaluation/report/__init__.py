# SPDX-License-Identifier: Apache-2.0
"""Measurements as one page that needs no network."""
