# SPDX-License-Identifier: Apache-2.0
"""Which of the keyframes that look like a new one geometry is asked about."""
