# SPDX-License-Identifier: Apache-2.0
"""What torch computes on: the device that is asked for, and of the CPU one thread."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from placerec.errors import cause_of
from placerec.networks.device import CPU, device_asked_for, no_such_device
from placerec.networks.place_network import PlaceNetwork


def on_device_asked_for(network: PlaceNetwork) -> tuple[PlaceNetwork, torch.device]:
    """Return a network moved to the device asked for, and that device.

    Raises:
        RecognizerError: torch has no such device here.
    """
    name = device_asked_for()
    try:
        device = torch.device(name)
        if name != CPU:
            torch.zeros(1, device=device).cpu()  # a device may have a name here and nothing behind
        return network.to(device), device
    except (RuntimeError, AssertionError, ImportError) as error:
        raise no_such_device(name, "torch", cause_of(error)) from error


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
