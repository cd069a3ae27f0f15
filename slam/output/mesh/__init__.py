# SPDX-License-Identifier: Apache-2.0
"""The map as surfaces, before loops were closed and after, and how sharp both are."""
