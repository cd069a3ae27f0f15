# SPDX-License-Identifier: Apache-2.0
"""Scenes to learn places from, and paths to validate on, every view with its exact pose."""
