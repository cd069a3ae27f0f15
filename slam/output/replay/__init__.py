# SPDX-License-Identifier: Apache-2.0
"""What a run measured, on disk; and the run once more, decided again or finished, by that alone."""
