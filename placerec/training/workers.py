# SPDX-License-Identifier: Apache-2.0
"""The processes that share one training: one per GPU under torchrun, else this one alone."""

import os
from collections.abc import Iterable

import torch
from torch import Tensor, distributed


class Workers:
    """Splits work among the processes and adds up what they found, so that all hold the same.

    Attributes:
        rank: which process this is, from 0.
        count: how many there are.
        is_first: whether this process writes files.
        device: what this process computes on.
    """

    def __init__(self) -> None:
        """Join the processes that torchrun started, where it did, on a GPU each if there are."""
        self.count = int(os.environ.get("WORLD_SIZE", "1"))
        self.rank = int(os.environ.get("RANK", "0"))
        self.is_first = self.rank == 0
        self.device = torch.device("cpu")
        if torch.cuda.is_available():
            self.device = torch.device("cuda", int(os.environ.get("LOCAL_RANK", "0")))
            torch.cuda.set_device(self.device)
        if self.count > 1 and not distributed.is_initialized():
            backend = "nccl" if self.device.type == "cuda" else "gloo"
            distributed.init_process_group(backend)

    def share(self, count: int) -> range:
        """Return which of so many pieces of work are this process's."""
        return range(self.rank, count, self.count)

    def add_up(self, tensors: Iterable[Tensor]) -> None:
        """Replace tensors, in place, by their sums over all processes."""
        parts = list(tensors)
        if self.count == 1 or not parts:
            return
        together = torch.cat([part.flatten() for part in parts])
        distributed.all_reduce(together)
        sums = torch.split(together, [part.numel() for part in parts])
        for part, added in zip(parts, sums, strict=True):
            part.copy_(added.view_as(part))

    def agree(self, is_time: bool) -> bool:
        """Return the first process's answer, in all of them."""
        if self.count == 1:
            return is_time
        answer = torch.tensor(float(is_time), device=self.device)
        distributed.broadcast(answer, src=0)
        return bool(answer.item())
