# SPDX-License-Identifier: Apache-2.0
"""Networks on the device that is asked for, where torch runs them."""

import torch

from placerec.device import CPU, device_asked_for, no_such_device
from placerec.errors import cause_of
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
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        raise no_such_device(name, "torch", cause_of(error)) from error
