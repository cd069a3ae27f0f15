# SPDX-License-Identifier: Apache-2.0
"""A map on disk, for later runs; `docs/maps.md` is its layout."""
