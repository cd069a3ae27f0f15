# SPDX-License-Identifier: Apache-2.0
"""Weights that Caffe wrote (.caffemodel), read without Caffe.

The file is one protocol buffer, of which little is needed: NetParameter holds layers, a layer has a
name and blobs, a blob a shape and its numbers (caffe.proto). All other fields are skipped.
"""

from collections import defaultdict
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

_LAYERS = {100: (1, 7), 2: (4, 6)}
"""Field of the layers in NetParameter, and of a layer's name and blobs; now, and before 2015."""
_DATA, _SHAPE, _DIM = 5, 7, 1
_OLD_SHAPE = (1, 2, 3, 4)
"""Of a blob before 2015: num, channels, height, width."""
_VARINT, _EIGHT_BYTES, _CHUNK, _FOUR_BYTES = 0, 1, 2, 5


def read_caffemodel(content: bytes) -> dict[str, NDArray[np.float32]]:
    """Return each layer's arrays as `conv1.weight` and `conv1.bias`, shaped as torch shapes them.

    Raises:
        ValueError: this is no such file, or not all of it.
    """
    arrays: dict[str, NDArray[np.float32]] = {}
    net = _Message(memoryview(content))
    for field, (name_field, blob_field) in _LAYERS.items():
        for layer in map(_Message, net.chunks[field]):
            names = [bytes(name).decode() for name in layer.chunks[name_field]]
            blobs = [_blob(_Message(blob)) for blob in layer.chunks[blob_field]]
            if blobs and not names:
                raise ValueError("a layer with weights has no name")
            for kind, blob in zip(("weight", "bias"), blobs, strict=False):
                arrays[f"{names[0]}.{kind}"] = blob.reshape(-1) if kind == "bias" else blob
    if not arrays:
        raise ValueError("there is no layer with weights")
    return arrays


class _Message:
    """A protocol buffer's integers, and its chunks of bytes that depend on the field, by field."""

    def __init__(self, content: memoryview) -> None:
        self.numbers: defaultdict[int, list[int]] = defaultdict(list)
        self.chunks: defaultdict[int, list[memoryview]] = defaultdict(list)
        position = 0
        while position < len(content):
            key, position = _varint(content, position)
            number, kind = key >> 3, key & 7
            if kind == _VARINT:
                value, position = _varint(content, position)
                self.numbers[number].append(value)
                continue
            size = {_EIGHT_BYTES: 8, _FOUR_BYTES: 4}.get(kind)
            if kind == _CHUNK:
                size, position = _varint(content, position)
            if size is None or position + size > len(content):
                raise ValueError(f"field {number} is of kind {kind}, or cut off")
            self.chunks[number].append(content[position : position + size])
            position += size


def _blob(blob: _Message) -> NDArray[np.float32]:
    shape = [(blob.numbers[field] or [1])[-1] for field in _OLD_SHAPE]
    for dims in map(_Message, blob.chunks[_SHAPE][:1]):
        shape = dims.numbers[_DIM] + [dim for part in dims.chunks[_DIM] for dim in _varints(part)]
    numbers = np.frombuffer(b"".join(blob.chunks[_DATA]), "<f4")
    return numbers.astype(np.float32).reshape(shape)


def _varints(message: memoryview) -> Iterator[int]:
    position = 0
    while position < len(message):
        number, position = _varint(message, position)
        yield number


def _varint(message: memoryview, position: int) -> tuple[int, int]:
    """Return the number of seven bits a byte, lowest first, and where it ends."""
    number = 0
    for shift in range(0, 70, 7):
        if position >= len(message):
            break
        byte = message[position]
        position += 1
        number |= (byte & 0x7F) << shift
        if byte < 0x80:
            return number, position
    raise ValueError("a number is cut off or too long")
