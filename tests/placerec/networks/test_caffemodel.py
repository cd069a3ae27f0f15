# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from torch import nn

from placerec.networks.caffemodel import read_caffemodel


@pytest.fixture
def content(tmp_path, write_caffemodel, request):
    layers = nn.Sequential()
    layers.add_module("conv1", nn.Conv2d(3, 40, kernel_size=5))
    layers.add_module("relu1", nn.ReLU())
    layers.add_module("conv2_new", nn.Conv2d(40, 6, kernel_size=3, groups=2, bias=False))
    old = getattr(request, "param", False)
    return layers, write_caffemodel(tmp_path / "net.caffemodel", layers, old).read_bytes()


@pytest.mark.parametrize("content", [False, True], indirect=True, ids=["now", "before 2015"])
def test_arrays_have_the_names_shapes_and_numbers_of_the_layers(content):
    layers, bytes_ = content
    found = read_caffemodel(bytes_)
    expected = layers.state_dict()
    assert sorted(found) == sorted(expected)
    for name, values in expected.items():
        assert found[name].dtype == np.float32
        assert np.array_equal(found[name], values.numpy())


def test_a_file_by_hand():
    # NetParameter.layer (100) of 22 bytes: name "fc", a blob of shape (1, 2) with 1.0 and -2.0.
    blob = bytes([0x3A, 4, 0x0A, 2, 1, 2, 0x2A, 8, 0, 0, 0x80, 0x3F, 0, 0, 0, 0xC0])
    layer = bytes([0x0A, 2, *b"fc", 0x3A, len(blob)]) + blob
    found = read_caffemodel(bytes([0xA2, 0x06, len(layer)]) + layer)
    assert list(found) == ["fc.weight"]
    assert found["fc.weight"].tolist() == [[1.0, -2.0]]


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: b"",
        lambda content: content[:-1],
        lambda content: content[: len(content) // 2],
        lambda content: b"\xff" * 40,
        lambda content: b"<html>not found</html>",
        lambda content: bytes([0xA2, 0x06, 8, 0x3A, 6, 0x2A, 4, 0, 0, 0x80, 0x3F]),  # no name
    ],
)
def test_what_is_no_such_file_or_not_all_of_it_is_refused(content, damage):
    with pytest.raises(ValueError):
        read_caffemodel(damage(content[1]))
