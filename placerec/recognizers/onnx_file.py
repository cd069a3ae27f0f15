# SPDX-License-Identifier: Apache-2.0
"""Any network as a place recognizer: an ONNX file, run by onnxruntime."""

import hashlib
import json
import logging
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from placerec.certificate import Certificate, certificate_beside, certificate_path
from placerec.errors import RecognizerError, cause_of
from placerec.files import MOST_ONNX_BYTES, is_file, read_bytes, read_toml
from placerec.networks.preprocessing import Preprocessing

METADATA_KEY = "placerec"
_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_SIZE_PX = (224, 224)
"""Of networks that take any: a multiple of 14, 16 and 32, the cells of most."""
_ANY_SIMILARITY = 0.0
_IMAGES_PER_PASS = 32
_TYPES = {"tensor(float)": np.float32, "tensor(float16)": np.float16}
_LOCATION = re.compile(rb"\x6a..?\x0a\x08location\x12(.[\x01-\x0f]?)", re.DOTALL)
"""How a tensor that lies in another file says in which: its field 13, a key, a value's length."""
_log = logging.getLogger(__name__)

_Side = Annotated[int, Field(ge=1, le=4096)]
_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_Finite = Annotated[float, Field(allow_inf_nan=False)]


class OnnxSettings(BaseModel):
    """What a network must be told with, in its metadata, or in a TOML file beside it, which wins.

    Attributes:
        size: (width, height) that images are resized to, where the network takes any.
        mean, std: per channel in the network's order, on pixel values from 0 to 1.
        order: whether red or blue comes first.
        output: name of the embedding among several outputs.
        min_similarity: cosine from which a match is worth verifying, unless a certificate says.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    size: tuple[_Side, _Side] | None = None
    mean: tuple[_Finite, _Finite, _Finite] | None = None
    std: tuple[_Positive, _Positive, _Positive] | None = None
    order: Literal["rgb", "bgr"] = "rgb"
    output: str | None = None
    min_similarity: Annotated[float, Field(ge=-1.0, le=1.0)] | None = None


class OnnxRecognizer:
    """A network from images to vectors, read from an ONNX file; on the CPU, on one thread.

    Its input is (N, 3, H, W), or (N, H, W, 3), of floats; its output (N, D), brought to unit length
    here. What it cannot know is taken from `OnnxSettings`, or assumed with a warning. A file can
    run no code, and tensors in files outside its folder are refused.

    Attributes:
        min_similarity: of the certificate beside the file, of the settings, or one that lets
            everything be verified.
        weights: which ones these are, in a line.
        metadata: all that the file says about itself.
        dimension: how many values an embedding has.
    """

    min_similarity: float

    def __init__(self, path: Path) -> None:
        """Read the network and try it out on an empty image.

        Raises:
            RecognizerError: the file or one that it names is missing or damaged, onnxruntime is not
                installed or cannot run it, its input or output is of another kind, or its settings
                cannot be used.
        """
        self._path = path
        # Read at once: files of others are asked what they are before onnxruntime opens them.
        content = read_bytes(path, MOST_ONNX_BYTES, what="the network", kind=RecognizerError)
        self._files = (path, *_tensor_files(content, path))
        opened = _open(path)
        self._session, self.metadata = opened.session, opened.metadata
        settings = _read_settings(self.metadata, path)
        self._input, self._is_last, self._is_batched, size = _input_of(opened.inputs, path)
        self.preprocessing = self._prepared_as(settings, size)
        self._output = _output_of(opened.outputs, settings.output, path)
        self.dimension = self._try_out()
        side = f"{self.preprocessing.width_px}x{self.preprocessing.height_px} px"
        self.weights = f"{path.name} at {side}, by onnxruntime"
        self.min_similarity = self._threshold(settings)

    @cached_property
    def fingerprint(self) -> str:
        """What a certificate knows the network by: its files and how images are prepared."""
        digest = hashlib.sha256(f"{self.preprocessing} {self._output}".encode())
        for file in self._files:
            with file.open("rb") as stream:
                digest.update(hashlib.file_digest(stream, "sha256").digest())
        return f"sha256:{digest.hexdigest()}"

    @cached_property
    def certificate(self) -> Certificate | None:
        """What min_similarity was calibrated on, where a certificate lies beside the file.

        Raises:
            RecognizerError: it cannot be read, or is of another network.
        """
        certificate = certificate_beside(self._path)
        if certificate and certificate.fingerprint != self.fingerprint:
            raise RecognizerError(
                f"the certificate is of another network than {self._path.name}, or of other "
                "settings; calibrate this one with `placerec calibrate`, or remove it: "
                f"{certificate_path(self._path)}"
            )
        return certificate

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the (D,) float32 unit-length embedding of a (H, W, 3) uint8 RGB image of any size.

        Grey (H, W) and (H, W, 4) with alpha are taken too.

        Raises:
            RecognizerError: it is no such image, or the network fails on it.
        """
        row: NDArray[np.float32] = _unit_rows(self._run([image]), self._path)[0]
        return row

    def embed_many(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """Return the (N, D) float32 embeddings of N images, several to a pass where it takes them.

        Raises:
            RecognizerError: as for `embed`.
        """
        count = _IMAGES_PER_PASS if self._is_batched else 1
        rows = [np.empty((0, self.dimension), np.float32)]
        for start in range(0, len(images), count):
            rows.append(_unit_rows(self._run(images[start : start + count]), self._path))
        return np.concatenate(rows)

    def _prepared_as(self, settings: OnnxSettings, fixed: tuple[int, int] | None) -> Preprocessing:
        """Return how images are prepared, and say what of that was assumed."""
        if fixed and settings.size and settings.size != fixed:
            raise RecognizerError(
                f"size = {list(settings.size)}: the network takes {list(fixed)} (width, height) "
                f"and no other: {self._path}"
            )
        assumed = []
        if settings.mean is None or settings.std is None:
            assumed.append("the mean and std of ImageNet, red first")
        width_px, height_px = fixed or settings.size or _SIZE_PX
        if not (fixed or settings.size):
            assumed.append(f"a size of {width_px} x {height_px}")
        if assumed:
            _log.warning(
                "%s does not say how images are prepared: taking %s; %s can say otherwise",
                *(self._path.name, " and ".join(assumed), _settings_path(self._path).name),
            )
        return Preprocessing(
            width_px,
            height_px,
            mean=_of_pixels(settings.mean or _IMAGENET_MEAN),
            scale=_of_pixels(settings.std or _IMAGENET_STD),
            is_bgr=settings.order == "bgr",
        )

    def _threshold(self, settings: OnnxSettings) -> float:
        """Return from which cosine a match is worth verifying, and say where nobody knows."""
        certificate = certificate_beside(self._path)
        if certificate and certificate.fingerprint == self.fingerprint:
            return certificate.min_similarity
        if settings.min_similarity is not None:
            return settings.min_similarity
        _log.warning(
            "%s has no threshold yet: what is more alike than at random (%g) is verified; "
            "`placerec calibrate DATA --recognizer %s` finds one",
            *(self._path.name, _ANY_SIMILARITY, self._path),
        )
        return _ANY_SIMILARITY

    def _try_out(self) -> int:
        """Return how many values there are in an embedding."""
        height, width = self.preprocessing.height_px, self.preprocessing.width_px
        return int(self._run([np.zeros((height, width, 3), np.uint8)]).shape[1])

    def _run(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """Return what the network makes of images, (N, D)."""
        inputs = np.stack([self.preprocessing(image) for image in images])
        if self._is_last:
            inputs = inputs.transpose(0, 2, 3, 1)
        inputs = np.ascontiguousarray(inputs, _TYPES[self._input.type])
        try:
            answer: object = self._session.run([self._output], {self._input.name: inputs})[0]
        except Exception as error:  # onnxruntime's are of no kind of their own
            size = f"{self.preprocessing.width_px} x {self.preprocessing.height_px}"
            raise RecognizerError(
                f"the network does not run on images of {size}; if it needs another size, say it "
                f"in {_settings_path(self._path).name}: {_why(error)}: {self._path}"
            ) from error
        values = np.asarray(answer)
        sides = [side for side in values.shape[1:] if side != 1]
        is_rows = values.ndim > 1 and len(values) == len(images) and len(sides) == 1
        if not is_rows or values.size == 0 or values.dtype.kind != "f":
            raise RecognizerError(
                f"output {self._output!r} of the network is {values.dtype} of shape {values.shape};"
                f" an embedding is of floats and (1, D): {self._path}"
            )
        return values.reshape(len(images), -1).astype(np.float32)


def _of_pixels(values: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return values on a scale to 1 on that of pixels, to 255."""
    first, second, third = (255.0 * value for value in values)
    return first, second, third


class _Value(NamedTuple):
    """What goes in or out; a side of its shape that may be any has a name or None for a number."""

    name: str
    type: str
    shape: tuple[int | str | None, ...]


class _Opened(NamedTuple):
    session: Any
    metadata: dict[str, str]
    inputs: list[_Value]
    outputs: list[_Value]


def _open(path: Path) -> _Opened:
    try:
        import onnxruntime
    except ImportError as error:
        raise RecognizerError(
            f"an ONNX file needs the package onnxruntime: pip install 'loopclose[onnx]': {path}"
        ) from error
    options = onnxruntime.SessionOptions()
    # As torch's: a second thread changes the last bits, and waits for ever on a busy machine.
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.use_deterministic_compute = True
    options.log_severity_level = 4  # what it prints by itself comes back as an exception, too
    try:
        session = onnxruntime.InferenceSession(
            path,
            options,
            providers=["CPUExecutionProvider"],
            enable_fallback=0,  # to the same once more, which it would print
        )
        # Asked here, because the names of a damaged file may be no text.
        return _Opened(
            session,
            session.get_modelmeta().custom_metadata_map,
            *(
                [_Value(each.name, each.type, tuple(each.shape)) for each in values]
                for values in (session.get_inputs(), session.get_outputs())
            ),
        )
    except Exception as error:  # onnxruntime's are of no kind of their own
        raise RecognizerError(f"onnxruntime cannot open it: {_why(error)}: {path}") from error


def _why(error: Exception) -> str:
    """Return the message of onnxruntime without what it puts before each."""
    return re.sub(r"^\w+: \[ONNXRuntimeError\] : \d+ : \w+ : ", "", cause_of(error))


def _tensor_files(content: bytes, path: Path) -> tuple[Path, ...]:
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


def _settings_path(path: Path) -> Path:
    return path.with_suffix(".toml")


def _read_settings(metadata: Mapping[str, str], path: Path) -> OnnxSettings:
    """Return what the metadata say, and a TOML file beside the network, which wins."""
    try:
        known = json.loads(metadata.get(METADATA_KEY, "{}"))
    except ValueError as error:
        raise RecognizerError(
            f"the metadata {METADATA_KEY!r} of the network are not JSON: {error}: {path}"
        ) from error
    if not isinstance(known, dict):
        raise RecognizerError(f"the metadata {METADATA_KEY!r} are no names and values: {path}")
    source, beside = path, _settings_path(path)
    _validated(known, source)
    if is_file(beside):
        known, source = known | read_toml(beside, kind=RecognizerError), beside
    return _validated(known, source)


def _validated(known: Mapping[str, object], source: Path) -> OnnxSettings:
    try:
        return OnnxSettings.model_validate(known)
    except ValidationError as error:
        first = error.errors()[0]
        name = str(first["loc"][0])
        allowed = ", ".join(OnnxSettings.model_fields)
        raise RecognizerError(
            f"{name} = {known.get(name)!r} cannot be used for the network: {first['msg']} "
            f"(known are {allowed}): {source}"
        ) from error


def _input_of(
    inputs: Sequence[_Value], path: Path
) -> tuple[_Value, bool, bool, tuple[int, int] | None]:
    """Return the input, whether channels come last, whether it takes several, and its size.

    The size is (width, height), None where it takes any.
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
    return only, is_last, sides[0] is None, size


def _output_of(outputs: Sequence[_Value], name: str | None, path: Path) -> str:
    """Return the output that is the embedding: the one named, the only one, or the only row."""
    told = ", ".join(f"{each.name} {each.shape}" for each in outputs)
    if name is not None:
        if name not in [each.name for each in outputs]:
            raise RecognizerError(f"output = {name!r}: the network has {told}: {path}")
        return name
    rows = [each.name for each in outputs if len(each.shape) == 2 or len(outputs) == 1]
    if len(rows) != 1:
        raise RecognizerError(
            f"the network has several outputs, {told}; say which is the embedding, (N, D), by "
            f"output = NAME in {_settings_path(path).name}: {path}"
        )
    return rows[0]


def _unit_rows(values: NDArray[np.float32], path: Path) -> NDArray[np.float32]:
    lengths = np.linalg.norm(values.astype(np.float64), axis=1, keepdims=True)
    if not np.isfinite(lengths).all() or (lengths == 0.0).any():
        raise RecognizerError(
            f"the network gives a vector that is zero, or has values that are NaN or infinite; "
            f"is it fed what it was trained with, as {_settings_path(path).name} can say?: {path}"
        )
    return np.asarray(values / lengths, np.float32)
