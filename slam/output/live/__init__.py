# SPDX-License-Identifier: Apache-2.0
"""A run as it goes on, in a Rerun viewer or in a file for one: only where that is asked for."""
