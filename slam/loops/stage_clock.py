# SPDX-License-Identifier: Apache-2.0
"""Wall time per stage of the pipeline."""

import time
from collections.abc import Iterator
from contextlib import contextmanager


class StageClock:
    """Adds up the seconds spent in each named stage, in the order the stages first ran.

    Stages in different threads overlap, so that their sum may be longer than the run.

    Attributes:
        seconds: of each stage.
        elapsed_s: from the first stage's beginning to the end of the last that ended.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.elapsed_s = 0.0
        self._start_s = float("inf")

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time until the block ends towards a stage."""
        start_s = time.perf_counter()
        self._start_s = min(self._start_s, start_s)
        try:
            yield
        finally:
            end_s = time.perf_counter()
            self.seconds[name] = self.seconds.get(name, 0.0) + end_s - start_s
            self.elapsed_s = max(self.elapsed_s, end_s - self._start_s)
