# SPDX-License-Identifier: Apache-2.0
"""A trained network as an ONNX file, which other programs run, and onnxruntime without torch."""

import json
import warnings
from copy import deepcopy
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from placerec.errors import RecognizerError, cause_of
from placerec.networks.onnx_settings import METADATA_KEY, OnnxSettings
from placerec.networks.place_network import PlaceNetwork

_OPSET = 17


class _Written(nn.Module):
    """A network whose cells are averaged by two matrices: ONNX has no cells of unequal size."""

    def __init__(self, network: PlaceNetwork) -> None:
        super().__init__()
        self._network, self._grid = network, network.grid

    def forward(self, images: Tensor) -> Tensor:
        maps = self._network.features(images)
        if self._grid:
            rows, columns = (
                functional.adaptive_avg_pool1d(torch.eye(int(side))[None], cells)[0]
                for side, cells in zip(maps.shape[2:], self._grid, strict=True)
            )
            maps = rows.T @ maps @ columns
        values = self._network.pool[1](maps)
        return functional.normalize(self._network.fully_connected(values))


def to_onnx(network: PlaceNetwork, min_similarity: float) -> Any:
    """Return a network from prepared images, (N, 3, H, W), to embeddings, (N, D), as an ONNX model.

    Its metadata say how images are prepared, as `placerec.recognizers.onnx_file` reads it. The same
    network gives the same model.

    Raises:
        RecognizerError: the package onnx is not installed, or ONNX has no words for the network.
    """
    try:
        import onnx
    except ImportError as error:
        raise RecognizerError(
            "writing ONNX needs the package onnx: pip install 'loopclose[onnx]'"
        ) from error
    preprocessing = network.preprocessing
    images = torch.zeros(1, 3, preprocessing.height_px, preprocessing.width_px)
    any_number = {0: "n"}
    try:
        with TemporaryDirectory() as folder, warnings.catch_warnings(), torch.inference_mode():
            written = Path(folder) / "network.onnx"
            # Of two exporters this one needs no further package; torch would rather have the other.
            warnings.simplefilter("ignore")
            torch.onnx.export(
                _Written(deepcopy(network).cpu()),  # it may run on another device
                (images,),
                written,
                dynamo=False,
                opset_version=_OPSET,
                input_names=["image"],
                output_names=["embedding"],
                dynamic_axes={"image": any_number, "embedding": any_number},
            )
            model = onnx.load(written)
    except Exception as error:  # torch has many
        raise RecognizerError(
            f"the network cannot be written as ONNX: {cause_of(error)}"
        ) from error
    for node in model.graph.node:
        node.ClearField("doc_string")  # paths of this machine
    settings = OnnxSettings(
        size=(preprocessing.width_px, preprocessing.height_px),
        mean=_of_one(preprocessing.mean),
        std=_of_one(preprocessing.scale),
        order="bgr" if preprocessing.is_bgr else "rgb",
        min_similarity=min_similarity,
    )
    told = json.dumps(settings.model_dump(exclude_none=True))
    onnx.helper.set_model_props(model, {METADATA_KEY: told})
    return model


def _of_one(values: tuple[float, float, float]) -> tuple[float, float, float]:
    """Return values on a scale of pixels, to 255, on one to 1."""
    first, second, third = (value / 255.0 for value in values)
    return first, second, third
