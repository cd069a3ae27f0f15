# SPDX-License-Identifier: Apache-2.0
"""A trained network as a place recognizer."""

from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from placerec.certificate import (
    Certificate,
    certificate_beside,
    certificate_path,
    write_certificate,
)
from placerec.errors import RecognizerError
from placerec.networks import TRUNKS, Trunk
from placerec.networks.device import on_another
from placerec.networks.torch_device import on_device_asked_for, one_thread
from placerec.networks.weights_file import hash_network, load_weights, set_min_similarity
from placerec.recognizers.fitted_file import NETWORKS_TRAINED_ON, shipped

DEFAULT_WEIGHTS = shipped("default")
_FRAMES_PER_PASS = 32


class LearnedRecognizer:
    """A network trained with the multi-constraint loss; safe to use by threads.

    It is run on the CPU, unless $LOOPCLOSE_DEVICE names something else.

    Attributes:
        network: the trained network.
        min_similarity: cosine from which a match is worth verifying, stored with the weights.
        weights: which ones these are, in a line.
        trained_on: names of datasets, as far as known: of the default weights.
    """

    min_similarity: float

    def __init__(
        self, path: Path = DEFAULT_WEIGHTS, trunks: Iterable[Trunk] = tuple(TRUNKS.values())
    ) -> None:
        """Read the weights; the trunks are those they may be made with, one's own included.

        Raises:
            RecognizerError: the weights cannot be read, are damaged, or do not fit, or there is no
                such device.
        """
        if path == DEFAULT_WEIGHTS and not path.exists():
            raise RecognizerError(
                "no trained weights are installed; name a file made by `placerec train`, or "
                f"another recognizer: {path}"
            )
        network, self.min_similarity = load_weights(path, trunks)
        self.network, self._device = on_device_asked_for(network)
        self._path = path
        is_default = path == DEFAULT_WEIGHTS
        title = "those of the package" if is_default else path.name
        self.weights = f"{self.network.title}, trained for places: {title}{on_another()}"
        self.trained_on: tuple[str, ...] = NETWORKS_TRAINED_ON if is_default else ()

    @cached_property
    def fingerprint(self) -> str:
        """What a certificate knows the weights by; it does not depend on min_similarity."""
        return hash_network(self.network)

    @cached_property
    def certificate(self) -> Certificate | None:
        """What min_similarity was calibrated on, where a certificate lies beside the weights.

        Raises:
            RecognizerError: it cannot be read, or is of other weights.
        """
        certificate = certificate_beside(self._path)
        if certificate and certificate.fingerprint != self.fingerprint:
            raise RecognizerError(
                f"the certificate is of other weights than {self._path.name}; calibrate these "
                f"with `placerec calibrate`, or remove it: {certificate_path(self._path)}"
            )
        return certificate

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the (D,) float32 unit-length embedding of a (H, W, 3) uint8 RGB image of any size.

        Grey (H, W) and (H, W, 4) with alpha are taken too.

        Raises:
            RecognizerError: it is no such image.
        """
        with one_thread():
            row: NDArray[np.float32] = self._embedded([image])[0]
            return row

    def embed_many(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """Return the (N, D) float32 embeddings of N images, several to a forward pass."""
        rows = [np.empty((0, self.network.dimension), np.float32)]
        for start in range(0, len(images), _FRAMES_PER_PASS):
            rows.append(self._embedded(images[start : start + _FRAMES_PER_PASS]))
        return np.concatenate(rows)

    def _embedded(self, images: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        with torch.inference_mode():
            rows = self.network(self.network.prepare(images).to(self._device))
            return np.asarray(rows.cpu(), np.float32)

    def embed_place(self, frames: Sequence[NDArray[np.uint8]]) -> NDArray[np.float32]:
        """Return the (D,) float32 unit-length embedding of a place seen in consecutive frames.

        It is the centre of the frames' embeddings (eq. 3), put back on the unit sphere.

        Raises:
            RecognizerError: there are no frames.
        """
        if len(frames) == 0:
            raise RecognizerError("a place needs at least 1 frame to be described by, not 0")
        centre = self.embed_many(frames).mean(axis=0)
        return np.asarray(centre / np.linalg.norm(centre), np.float32)


def keep_calibration(weights: Path, certificate: Certificate) -> Path:
    """Give weights the threshold that they were calibrated to, and return the certificate's path.

    Raises:
        RecognizerError: the weights cannot be read, or one of the files cannot be written.
    """
    path = certificate_path(weights)
    # The evidence first: without the rest it is still true, and shows that the rest is missing.
    write_certificate(certificate, path)
    set_min_similarity(weights, certificate.min_similarity)
    return path
