# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a recording and its loops, made on purpose and by a seed."""
