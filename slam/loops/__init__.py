# SPDX-License-Identifier: Apache-2.0
"""Places seen again: proposed by the recognizer, verified, and the map corrected to them."""
