# SPDX-License-Identifier: Apache-2.0
"""What a recognizer is worth on images whose places are known."""
