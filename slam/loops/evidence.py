# SPDX-License-Identifier: Apache-2.0
"""Which pixels of loop candidates matched: kept in memory of no more than can be shown."""

from dataclasses import replace

from slam.types import LoopAttempt

# Of the candidates of so many keyframes it is kept, and of the last ones.
_SHOWN_WITH_EVIDENCE, _RECENT = 500, 1000


class Evidence:
    """Forgets which pixels matched where a journal has it by now.

    A match takes 60 bytes, and what a keyframe's candidates show takes as much as the keyframe.
    """

    def __init__(self) -> None:
        self._first = 0  # attempt that may have to lose it

    def tidy(self, attempts: list[LoopAttempt], keyframes: int) -> None:
        """Let attempts go without, in place, once those of so many keyframes are among them."""
        if keyframes <= _SHOWN_WITH_EVIDENCE:
            self._first = len(attempts)
            return
        for k in range(self._first, len(attempts) - _RECENT):
            if seen := attempts[k].verification:
                attempts[k] = replace(attempts[k], verification=seen.without_evidence)
            self._first = k + 1
