# SPDX-License-Identifier: Apache-2.0
"""How many threads torch computes on."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch


@contextmanager
def one_thread() -> Iterator[None]:
    """Let torch compute what is inside on one thread.

    A second one saves a few milliseconds on an idle machine, costs ten times as many on a busy one,
    and changes the last bits with the number of cores.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
