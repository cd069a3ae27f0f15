# SPDX-License-Identifier: Apache-2.0
"""Landmarks, the keyframes that see them, and their adjustment to each other."""
