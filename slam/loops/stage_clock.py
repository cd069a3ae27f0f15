# SPDX-License-Identifier: Apache-2.0
"""Wall time per stage of the pipeline."""

import time
from collections.abc import Iterator
from contextlib import contextmanager

from placerec.compiled import compiling_s


class StageClock:
    """Adds up the seconds spent in each named stage, in the order the stages first ran.

    Stages in different threads overlap, so that their sum may be longer than the run.

    Attributes:
        seconds: of each stage.
        elapsed_s: from the first stage's beginning to the end of the last that ended.
        compiling_s: for how long of that something was compiled, which later runs find.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.elapsed_s = self.compiling_s = 0.0
        self._start_s: float | None = None
        self._compiled_s = 0.0  # before

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Count the time until the block ends towards a stage."""
        start_s = time.perf_counter()
        if self._start_s is None:
            self._start_s, self._compiled_s = start_s, compiling_s()
        try:
            yield
        finally:
            end_s = time.perf_counter()
            self.seconds[name] = self.seconds.get(name, 0.0) + end_s - start_s
            self.elapsed_s = max(self.elapsed_s, end_s - self._start_s)
            self.compiling_s = compiling_s() - self._compiled_s
