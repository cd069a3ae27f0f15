# SPDX-License-Identifier: Apache-2.0
"""Weights that Caffe wrote (.caffemodel), read without Caffe.

The file is one protocol buffer, of which little is needed: NetParameter holds layers, a layer has a
name and blobs, a blob a shape and its numbers (caffe.proto). All other fields are skipped.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float32]

LAYERS = {100: (1, 7), 2: (4, 6)}
"""Field of the layers in NetParameter, and of a layer's name and blobs; now, and before 2015."""
DATA, SHAPE, DIM = 5, 7, 1
OLD_SHAPE = (1, 2, 3, 4)
"""Of a blob before 2015: num, channels, height, width."""
KINDS = ("weight", "bias")

VARINT, EIGHT_BYTES, CHUNK, FOUR_BYTES = 0, 1, 2, 5


def read_caffemodel(content: bytes) -> dict[str, FloatArray]:
    """Return each layer's arrays as `conv1.weight` and `conv1.bias`, shaped as torch shapes them.

    Raises:
        ValueError: this is no such file, or not all of it.
    """
    arrays: dict[str, FloatArray] = {}
    for field, layer in _fields(memoryview(content)):
        if field not in LAYERS or isinstance(layer, int):
            continue
        name_field, blob_field = LAYERS[field]
        parts = list(_fields(layer))
        names = [bytes(part).decode() for number, part in _chunks(parts) if number == name_field]
        blobs = [_blob(part) for number, part in _chunks(parts) if number == blob_field]
        if blobs and not names:
            raise ValueError("a layer with weights has no name")
        for kind, blob in zip(KINDS, blobs, strict=False):
            arrays[f"{names[0]}.{kind}"] = blob.reshape(-1) if kind == "bias" else blob
    if not arrays:
        raise ValueError("there is no layer with weights")
    return arrays


def _blob(message: memoryview) -> FloatArray:
    fields = list(_fields(message))
    numbers = b"".join(bytes(part) for number, part in _chunks(fields) if number == DATA)
    shapes = [_dims(part) for number, part in _chunks(fields) if number == SHAPE]
    plain = {number: value for number, value in fields if isinstance(value, int)}
    shape = shapes[0] if shapes else [plain.get(number, 1) for number in OLD_SHAPE]
    return np.frombuffer(numbers, "<f4").astype(np.float32).reshape(shape)


def _dims(message: memoryview) -> list[int]:
    dims: list[int] = []
    for number, value in _fields(message):
        if number == DIM and isinstance(value, int):
            dims.append(value)
        elif number == DIM and isinstance(value, memoryview):
            position = 0
            while position < len(value):
                dim, position = _varint(value, position)
                dims.append(dim)
    return dims


def _chunks(fields: list[tuple[int, int | memoryview]]) -> Iterator[tuple[int, memoryview]]:
    return ((number, value) for number, value in fields if isinstance(value, memoryview))


def _fields(message: memoryview) -> Iterator[tuple[int, int | memoryview]]:
    """Yield each field's number and its value: an integer, or bytes that depend on the field."""
    position = 0
    while position < len(message):
        key, position = _varint(message, position)
        number, kind = key >> 3, key & 7
        if kind == VARINT:
            value, position = _varint(message, position)
            yield number, value
            continue
        size = {EIGHT_BYTES: 8, FOUR_BYTES: 4}.get(kind)
        if kind == CHUNK:
            size, position = _varint(message, position)
        if size is None or position + size > len(message):
            raise ValueError(f"field {number} is of kind {kind}, or cut off")
        yield number, message[position : position + size]
        position += size


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
