# SPDX-License-Identifier: Apache-2.0
"""Any network as a place recognizer: an ONNX file, run by onnxruntime."""

import hashlib
import logging
from collections.abc import Sequence
from contextlib import suppress
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.certificate import Certificate, certificate_beside, certificate_path
from placerec.errors import RecognizerError
from placerec.files import MOST_ONNX_BYTES, read_bytes
from placerec.networks.device import on_another
from placerec.networks.onnx_settings import OnnxSettings, read_settings, settings_path
from placerec.networks.preprocessing import Preprocessing
from placerec.recognizers.onnx_session import (
    input_of,
    open_session,
    output_of,
    tensor_files,
    why,
)

_IMAGENET_MEAN, _IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
_SIZE_PX = (224, 224)
"""Of networks that take any: a multiple of 14, 16 and 32, the cells of most."""
_ANY_SIMILARITY = 0.0
_IMAGES_PER_PASS = 32
_log = logging.getLogger(__name__)


class OnnxRecognizer:
    """A network from images to vectors, read from an ONNX file; on the device asked for.

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
        self._files = (path, *tensor_files(content, path))
        opened = open_session(path)
        self._session, self.metadata = opened.session, opened.metadata
        settings = read_settings(self.metadata, path)
        self._input = input_of(opened.inputs, path)
        self.preprocessing = self._prepared_as(settings)
        self._output = output_of(opened.outputs, settings.output, path)
        self.dimension = self._try_out()
        side = f"{self.preprocessing.width_px}x{self.preprocessing.height_px} px"
        self.weights = f"{path.name} at {side}, by onnxruntime{on_another()}"
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
        count = _IMAGES_PER_PASS if self._input.is_batched else 1
        rows = [np.empty((0, self.dimension), np.float32)]
        for start in range(0, len(images), count):
            rows.append(_unit_rows(self._run(images[start : start + count]), self._path))
        return np.concatenate(rows)

    def _prepared_as(self, settings: OnnxSettings) -> Preprocessing:
        """Return how images are prepared, and say what of that was assumed."""
        fixed = self._input.size
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
                *(self._path.name, " and ".join(assumed), settings_path(self._path).name),
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
        with suppress(RecognizerError):  # who asks for the certificate is told what is wrong
            if self.certificate:
                return self.certificate.min_similarity
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
        if self._input.is_last:
            inputs = inputs.transpose(0, 2, 3, 1)
        inputs = np.ascontiguousarray(inputs, self._input.dtype)
        try:
            answer: object = self._session.run([self._output], {self._input.name: inputs})[0]
        except Exception as error:  # onnxruntime's are of no kind of their own
            size = f"{self.preprocessing.width_px} x {self.preprocessing.height_px}"
            raise RecognizerError(
                f"the network does not run on images of {size}; if it needs another size, say it "
                f"in {settings_path(self._path).name}: {why(error)}: {self._path}"
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


def _unit_rows(values: NDArray[np.float32], path: Path) -> NDArray[np.float32]:
    lengths = np.linalg.norm(values.astype(np.float64), axis=1, keepdims=True)
    if not np.isfinite(lengths).all() or (lengths == 0.0).any():
        raise RecognizerError(
            f"the network gives a vector that is zero, or has values that are NaN or infinite; "
            f"is it fed what it was trained with, as {settings_path(path).name} can say?: {path}"
        )
    return np.asarray(values / lengths, np.float32)
