# SPDX-License-Identifier: Apache-2.0
"""Maps of thousands of keyframes: what making one takes, and loading it."""
