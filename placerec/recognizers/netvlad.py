# SPDX-License-Identifier: Apache-2.0
"""NetVLAD: residuals to 64 words, softly assigned, whitened (Arandjelovic et al. 2016)."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn import functional

from placerec.errors import RecognizerError
from placerec.networks import TRUNKS
from placerec.networks.pooling import Vlad
from placerec.networks.pretrained import find_pretrained, read_weights
from placerec.networks.torch_device import one_thread
from placerec.networks.vgg16 import VGG16
from placerec.networks.whitening import principal_components, whitened_components
from placerec.recognizers.feature_maps import FeatureMaps, FittedToMaps, Layer, find_maps
from placerec.recognizers.fitted_file import Fitted

_PUBLISHED = Layer(
    # The last convolution before its ReLU, in files named ...netvlad... of the layout that PyTorch
    # implementations share: encoder.N, pool.conv, pool.centroids and, in some, WPCA.0.
    replace(
        VGG16,
        name="netvlad",
        blocks={"conv5_3": VGG16.blocks["conv5_3"] - 1},
        name_in_file="encoder.{}".format,
    ),
    "conv5_3",
    (640, 480),
)
_STAND_IN = Layer(TRUNKS["squeezenet"], "fire5", (227, 227))
_WORDS = 64
_LOCAL_VALUES, _VALUES, _MOST_VALUES = 16, 448, 4096
"""Of the stand-in's local features and its embedding, as many as make a small file, by average
precision on the validation floors of ie_tower; and of an embedding with published weights."""
_WORDS_FROM, _WHITENED_FROM = 300, 4096
"""Images, spread evenly, that words and whitening are found with."""


class NetVlad(FittedToMaps):
    """A network's local features, told by how they differ from words; the cosine compares.

    Runs on published weights, a file with netvlad in its name, where these are on the machine, and
    else on a trunk that was trained on ImageNet with words found by k-means; `weights` says which.

    Attributes:
        min_similarity: of the words; 1 % of the pairs of images of different validation floors of
            ie_tower are as similar with the shipped ones.
    """

    name = "netvlad"
    layers = (_PUBLISHED, _STAND_IN)
    min_similarity = 0.5

    def __init__(self, path: Path | None = None) -> None:
        """Read what was learned, by default the published weights alone, or what is shipped.

        Raises:
            RecognizerError: what is needed is missing, or does not fit.
        """
        published = find_pretrained("netvlad") if path is None else None
        if published:
            self._path, self._fitted, self.trained_on = None, Fitted({}), ()
            self._maps = FeatureMaps(self.layers[0], published)
        else:
            super().__init__(path)
        arrays = {name: torch.from_numpy(a).float() for name, a in self._fitted.arrays.items()}
        in_file = _published_head() if self._maps.title == self.layers[0].title else {}
        self._head = _Head({**in_file, **arrays}).eval()
        self.fingerprint = f"{self._maps.fingerprint} {self._fitted.fingerprint}"
        self.weights = self._maps.weights + _how_fitted(self._fitted, bool(in_file), self._head)

    @classmethod
    def fit(cls, images: Sequence[NDArray[np.uint8]], seed: int = 0) -> Fitted:
        """Return the whitening of images; without published weights, words found in them, too.

        Raises:
            RecognizerError: there are too few images, or no weights.
        """
        maps = find_maps(cls.layers)
        is_published = maps.title == cls.layers[0].title
        with torch.inference_mode():
            learned = {} if is_published else _find_words(maps, images, seed)
            head = _Head({**_published_head(), **learned} if is_published else learned)
            some = maps.of_some(images, _WHITENED_FROM)
            rows = torch.cat([head(torch.from_numpy(each)[None]) for each in some])
            learned |= whitening(rows, _MOST_VALUES if is_published else _VALUES)
        arrays = {name: value.numpy() for name, value in learned.items()}
        half = {"whitening.weight": arrays["whitening.weight"].astype(np.float16)}
        return Fitted(arrays | half, maps.facts)

    def embed(self, image: NDArray[np.uint8]) -> NDArray[np.float32]:
        """Return the (D,) float32 unit-length embedding of a uint8 RGB image of any size."""
        maps = torch.from_numpy(self._maps(image))[None]
        with one_thread(), torch.inference_mode():
            return np.asarray(self._head(maps)[0], np.float32)


class _Head(nn.Module):
    """From maps to an embedding; what the state lacks is left out."""

    def __init__(self, state: Mapping[str, Tensor]) -> None:
        super().__init__()
        words, channels = state["vlad.centroids"].shape
        self.vlad = Vlad(words, channels)
        self.local: nn.Module = nn.Identity()
        self.whitening: nn.Module = nn.Identity()
        if "local.weight" in state:
            values, channels = state["local.weight"].shape[:2]
            self.local = nn.Conv2d(channels, values, kernel_size=1)
        if "whitening.weight" in state:
            values, features = state["whitening.weight"].shape
            self.whitening = nn.Linear(features, values)
        try:
            self.load_state_dict(state)
        except RuntimeError as error:
            what = " ".join(str(error).split())
            raise RecognizerError(f"what was fitted is of no NetVLAD layer: {what}") from error

    def forward(self, maps: Tensor) -> Tensor:
        vectors = self.vlad(self.local(functional.normalize(maps, dim=1)))
        return functional.normalize(self.whitening(vectors))


def _published_head() -> dict[str, Tensor]:
    path = find_pretrained("netvlad")
    in_file = read_weights(path) if path else {}
    try:
        conv, centroids = in_file["pool.conv.weight"], in_file["pool.centroids"]
    except KeyError as error:
        raise RecognizerError(f"not weights of NetVLAD: there is no {error}: {path}") from error
    bias = in_file.get("pool.conv.bias", torch.zeros(len(conv)))
    head = {"vlad.conv.weight": conv, "vlad.conv.bias": bias, "vlad.centroids": centroids}
    if "WPCA.0.weight" in in_file:
        head["whitening.weight"] = in_file["WPCA.0.weight"].flatten(start_dim=1)
        head["whitening.bias"] = in_file["WPCA.0.bias"]
    return {name: value.float() for name, value in head.items()}


def _find_words(
    maps: FeatureMaps, images: Sequence[NDArray[np.uint8]], seed: int
) -> dict[str, Tensor]:
    """Return the principal components of local features, and words of what these leave of them."""
    some = (torch.from_numpy(each) for each in maps.of_some(images, _WORDS_FROM))
    local = torch.cat([functional.normalize(each[None], dim=1)[0].flatten(1).T for each in some])
    mean = local.mean(dim=0)
    directions, _ = principal_components(local - mean, _LOCAL_VALUES)
    vlad = Vlad(_WORDS, len(directions))
    vlad.start((local - mean) @ directions.T, seed)
    found = {f"vlad.{name}": value for name, value in vlad.state_dict().items()}
    local_layer = {"local.weight": directions[:, :, None, None], "local.bias": -directions @ mean}
    return found | local_layer


def whitening(rows: Tensor, at_most: int) -> dict[str, Tensor]:
    """Return a layer that makes (n, F) rows vary alike in their at most so many directions."""
    # As many directions as images, less one, vary at all.
    mean, weight = whitened_components(rows, min(at_most, max(1, len(rows) - 1)))
    return {"whitening.weight": weight.float(), "whitening.bias": (-weight @ mean).float()}


def _how_fitted(fitted: Fitted, is_published: bool, head: _Head) -> str:
    if not is_published:
        return f" in place of NetVLAD's; {_WORDS} words and whitening of {fitted.source}"
    if fitted.arrays:
        return f"; whitening of {fitted.source}"
    return "" if isinstance(head.whitening, nn.Linear) else "; not whitened"
