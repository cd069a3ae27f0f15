# SPDX-License-Identifier: Apache-2.0
"""When it is worth solving the graph on the way."""

from collections import Counter

from slam.types import Keyframe

# Loops of a segment wait until there are this share more of them than the last correction knew: the
# cost per segment then grows with the logarithm of their number.
_LOOP_GROWTH = 0.1
# An odometry from elsewhere is judged without a new loop too: after so many keyframes, and as many
# more as that share.
_JUDGED_AFTER = 1


class CorrectionSchedule:
    """Remembers what the last correction knew of."""

    def __init__(self) -> None:
        self._solved_loops: Counter[int] = Counter()
        self._newest_id = -1

    def is_due(self, newest: Keyframe, loops: Counter[int], has_given_pose: bool) -> bool:
        """Return whether to correct now, by the loops per segment of their later keyframe.

        An odometry from elsewhere may have the newest keyframe. The answer yes is remembered.
        """
        solved = self._solved_loops[newest.segment]
        has_more = loops[newest.segment] - solved > _LOOP_GROWTH * solved
        unjudged = newest.id - self._newest_id if has_given_pose else 0
        if not has_more and unjudged <= _JUDGED_AFTER + _LOOP_GROWTH * newest.id:
            return False
        self._solved_loops, self._newest_id = loops.copy(), newest.id
        return True
