# SPDX-License-Identifier: Apache-2.0
import pytest
import torch

from placerec.errors import RecognizerError
from placerec.networks import TRUNKS, PlaceNetwork
from placerec.networks.torch_device import on_device_asked_for


@pytest.fixture
def network():
    return PlaceNetwork(TRUNKS["mobilenet_v2"], 8, block="block3", size_px=(32, 24))


def test_a_network_is_on_the_cpu(network, monkeypatch):
    monkeypatch.delenv("LOOPCLOSE_DEVICE", raising=False)
    assert on_device_asked_for(network) == (network, torch.device("cpu"))


# A name that torch does not have, one that holds no values, one that is on no machine of the tests.
@pytest.mark.parametrize("device", ["abacus", "meta", "hpu", "cuda:99"])
def test_a_device_that_is_not_there_is_one_line(device, network, monkeypatch):
    monkeypatch.setenv("LOOPCLOSE_DEVICE", device)
    with pytest.raises(
        RecognizerError, match=rf"^LOOPCLOSE_DEVICE={device}: torch cannot use it"
    ) as told:
        on_device_asked_for(network)
    assert "\n" not in str(told.value)
