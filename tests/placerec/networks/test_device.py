# SPDX-License-Identifier: Apache-2.0
import pytest

from placerec.errors import RecognizerError
from placerec.networks.device import device_asked_for, images_at_once, on_another


def test_it_is_the_cpu_unless_something_else_is_asked_for(monkeypatch):
    monkeypatch.delenv("LOOPCLOSE_DEVICE", raising=False)
    assert device_asked_for() == "cpu"
    monkeypatch.setenv("LOOPCLOSE_DEVICE", " ")
    assert device_asked_for() == "cpu"


@pytest.mark.parametrize(
    ("asked", "device"), [("cuda", "cuda"), ("CUDA:1", "cuda:1"), (" cpu ", "cpu")]
)
def test_its_name_is_read_leniently(asked, device, monkeypatch):
    monkeypatch.setenv("LOOPCLOSE_DEVICE", asked)
    assert device_asked_for() == device


@pytest.mark.parametrize("asked", ["0", "cuda:", "cuda:x", "cpu:1", "cuda 1", "../cuda"])
def test_what_is_no_name_is_refused(asked, monkeypatch):
    monkeypatch.setenv("LOOPCLOSE_DEVICE", asked)
    with pytest.raises(RecognizerError, match="name one like cpu, cuda or cuda:1"):
        device_asked_for()


@pytest.mark.parametrize(("asked", "told", "count"), [("cpu", "", 1), ("cuda:1", " on cuda:1", 32)])
def test_elsewhere_than_on_the_cpu_is_told_and_takes_images_at_once(
    asked, told, count, monkeypatch
):
    monkeypatch.setenv("LOOPCLOSE_DEVICE", asked)
    assert (on_another(), images_at_once()) == (told, count)
