# SPDX-License-Identifier: Apache-2.0
"""Rigid transforms, features, and the motion between two views."""
