# SPDX-License-Identifier: Apache-2.0
"""An ONNX file opened by onnxruntime: which files it is, what it takes and what it gives."""

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from placerec.errors import RecognizerError, cause_of
from placerec.files import is_file
from placerec.networks.device import CPU, device_asked_for, no_such_device
from placerec.networks.onnx_settings import settings_path

_TYPES: dict[str, type[np.floating[Any]]] = {
    "tensor(float)": np.float32,
    "tensor(float16)": np.float16,
}
_LOCATION = re.compile(rb"\x6a..?\x0a\x08location\x12(.[\x01-\x0f]?)", re.DOTALL)
"""How a tensor that lies in another file says in which: its field 13, a key, a value's length."""


class Value(NamedTuple):
    """What goes in or out; a side of its shape that may be any has a name or None for a number."""

    name: str
    type: str
    shape: tuple[int | str | None, ...]


class Opened(NamedTuple):
    """A network that is ready to run, and what it says of itself."""

    session: Any
    metadata: dict[str, str]
    inputs: list[Value]
    outputs: list[Value]


class Input(NamedTuple):
    """The one input of a network, an image.

    Attributes:
        name, dtype: of what is handed over.
        is_last: whether channels come last, (N, H, W, 3).
        is_batched: whether it takes several images at once.
        size: (width, height), None where it takes any.
    """

    name: str
    dtype: type[np.floating[Any]]
    is_last: bool
    is_batched: bool
    size: tuple[int, int] | None


def open_session(path: Path) -> Opened:
    """Open a network, on the CPU and on one thread or on the device asked for.

    Raises:
        RecognizerError: onnxruntime is not installed, cannot open the file, or has no such device.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise RecognizerError(
            f"an ONNX file needs the package onnxruntime: pip install onnxruntime: {path}"
        ) from error
    options = onnxruntime.SessionOptions()
    # As torch's: a second thread changes the last bits, and waits for ever on a busy machine.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.enable_cpu_mem_arena = False  # it keeps more than one image after another needs
    options.log_severity_level = 4  # what it prints by itself comes back as an exception, too
    providers = _providers(onnxruntime.get_available_providers())
    try:
        session = onnxruntime.InferenceSession(
            path,
            options,
            providers=providers,
            enable_fallback=0,  # to the same once more, which it would print
        )
        if session.get_providers()[0] != providers[0][0]:  # its libraries are not on this machine
            raise no_such_device(device_asked_for(), "onnxruntime", "it does not start there")
        # Asked here, because the names of a damaged file may be no text.
        return Opened(
            session,
            session.get_modelmeta().custom_metadata_map,
            *(
                [Value(each.name, each.type, tuple(each.shape)) for each in values]
                for values in (session.get_inputs(), session.get_outputs())
            ),
        )
    except RecognizerError:
        raise
    except Exception as error:  # onnxruntime's are of no kind of their own
        raise RecognizerError(f"onnxruntime cannot open it: {why(error)}: {path}") from error


def _providers(available: Sequence[str]) -> list[tuple[str, dict[str, str]]]:
    """Return what onnxruntime calls the device asked for, and the CPU for what that cannot do."""
    device = device_asked_for()
    kind, _, number = device.partition(":")
    names = {each.removesuffix("ExecutionProvider").lower(): each for each in available}
    names.pop("azure", None)  # asks networks on the web, and leaves all others to the CPU
    if kind not in names:
        raise no_such_device(device, "onnxruntime", f"this build has {', '.join(names)}")
    options = {"device_id": number} if number else {}
    rest = [] if device == CPU else [("CPUExecutionProvider", dict[str, str]())]
    return [(names[kind], options), *rest]


def why(error: Exception) -> str:
    """Return the message of onnxruntime without what it puts before each."""
    return re.sub(r"^\w+: \[ONNXRuntimeError\] : \d+ : \w+ : ", "", cause_of(error))


def tensor_files(content: bytes, path: Path) -> tuple[Path, ...]:
    """Return the other files in which an ONNX file says that its tensors lie.

    Raises:
        RecognizerError: one is missing, or not in the folder of the file.
    """
    found = []
    for name in sorted(set(_locations(content))):
        where = Path(name)
        if where.is_absolute() or ".." in where.parts:
            raise RecognizerError(
                f"the network keeps tensors in a file outside its folder, {name!r}; "
                f"export it again: {path}"
            )
        if not is_file(path.parent / where):
            raise RecognizerError(
                f"the network keeps tensors in {name!r}, which is not beside it; "
                f"copy that file, too: {path}"
            )
        found.append(path.parent / where)
    return tuple(found)


def _locations(content: bytes) -> Iterator[str]:
    for match in _LOCATION.finditer(content):
        low, *high = match[1]
        is_long = low > 0x7F  # a length of 128 or more takes a second byte
        length = (low & 0x7F) + (high[0] << 7 if is_long and high else 0)
        start = match.start(1) + 1 + is_long
        yield content[start : start + length].decode("utf-8", "backslashreplace")


def input_of(inputs: Sequence[Value], path: Path) -> Input:
    """Return the input of a network that takes images.

    Raises:
        RecognizerError: there are several, or it takes something else.
    """
    if len(inputs) != 1:
        names = ", ".join(each.name for each in inputs)
        raise RecognizerError(f"the network has {len(inputs)} inputs ({names}), not 1: {path}")
    (only,) = inputs
    # A side without a number may be any.
    sides = [side if isinstance(side, int) else None for side in only.shape]
    is_image = len(sides) == 4 and only.type in _TYPES and sides[0] in (1, None)
    is_last = is_image and sides[1] != 3 and sides[3] == 3
    if not is_image or not (is_last or sides[1] in (3, None)):
        raise RecognizerError(
            f"input {only.name!r} of the network is {only.type} of shape {only.shape}; it must "
            f"be of floats and (N, 3, H, W) or (N, H, W, 3), N any or 1: {path}"
        )
    height, width = sides[1:3] if is_last else sides[2:]
    size = (width, height) if width and height else None
    return Input(only.name, _TYPES[only.type], is_last, sides[0] is None, size)


def output_of(outputs: Sequence[Value], name: str | None, path: Path) -> str:
    """Return the output that is the embedding: the one named, the only one, or the only row.

    Raises:
        RecognizerError: there is none of that name, or several could be it.
    """
    told = ", ".join(f"{each.name} {each.shape}" for each in outputs)
    if name is not None:
        if name not in [each.name for each in outputs]:
            raise RecognizerError(f"output = {name!r}: the network has {told}: {path}")
        return name
    rows = [each.name for each in outputs if len(each.shape) == 2 or len(outputs) == 1]
    if len(rows) != 1:
        raise RecognizerError(
            f"the network has several outputs, {told}; say which is the embedding, (N, D), by "
            f"output = NAME in {settings_path(path).name}: {path}"
        )
    return rows[0]
