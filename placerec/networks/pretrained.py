# SPDX-License-Identifier: Apache-2.0
"""Published weights of a trunk: read from a file, or downloaded and checked."""

import hashlib
import http.client
import io
import os
import re
import urllib.request
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, cast

import numpy as np
import safetensors.torch
import torch
from torch import Tensor

from placerec.errors import LoopcloseError, RecognizerError
from placerec.files import (
    MOST_WEIGHTS_BYTES,
    arrays_of,
    cache_folder,
    check_zip,
    read_bytes,
    write_atomically,
)
from placerec.networks.caffemodel import read_caffemodel
from placerec.networks.place_network import PlaceNetwork
from placerec.networks.trunk import Trunk
from placerec.recognizer import WEIGHTS_SUFFIX

FOLDER_VARIABLE = "LOOPCLOSE_WEIGHTS"
SUFFIXES = frozenset({".pth", ".tar", ".npz", ".caffemodel"})
_TIMEOUT_S = 30.0
_NETVLAD = "netvlad"
"""Its checkpoints are often named after the network that they begin with."""
_SCALAR = cast(Callable[..., object], np.float64(0.0).__reduce__()[0])
_NUMBERS: list[Callable[..., object] | tuple[Callable[..., object], str]] = [
    (_SCALAR, "numpy.core.multiarray.scalar"),
    (_SCALAR, "numpy._core.multiarray.scalar"),
    np.dtype,
    type(np.dtype(np.float64)),
]
"""Without which a checkpoint that notes its recall beside the weights would not be read."""


def load_pretrained(network: PlaceNetwork, path: Path) -> None:
    """Give a network's trunk the weights of a file.

    The file is a torchvision state dict (.pth), an archive of arrays (.npz), what Caffe wrote
    (.caffemodel), or what an earlier training wrote (.safetensors); what it holds beyond the
    trunk's layers, such as the original fully connected ones, is left out.

    Raises:
        RecognizerError: the file cannot be read, would run code, or is another network's.
    """
    weights, name = read_weights(path), network.trunk.name
    is_ours = path.suffix == WEIGHTS_SUFFIX
    name_in_file = "features.{}".format if is_ours else network.trunk.name_in_file
    state = network.features.state_dict()
    for parameter, value in state.items():
        in_file = name_in_file(parameter)
        found = weights.get(in_file)
        if found is None:
            raise RecognizerError(f"not weights of {name}: there is no {in_file}: {path}")
        if found.shape != value.shape:
            raise RecognizerError(
                f"not weights of {name}: {in_file} is {tuple(found.shape)}, not "
                f"{tuple(value.shape)}: {path}"
            )
        state[parameter] = found.to(value.dtype)
    network.features.load_state_dict(state)


def find_pretrained(name: str) -> Path | None:
    """Return the file of published weights whose name begins so, whatever its capitals, if any.

    A file that has netvlad anywhere in its name, as vgg16_netvlad.pth has, is of that alone.
    It is looked for in the folder that $LOOPCLOSE_WEIGHTS names, if it does, then in that of
    `download_pretrained`, and in the folders in these.
    """

    def is_of_it(file: str) -> bool:
        return name.lower() == _NETVLAD if _NETVLAD in file else file.startswith(name.lower())

    found = [
        path
        for folder in weights_folders()
        for path in sorted((*folder.glob("*"), *folder.glob("*/*")))
        if is_of_it(path.name.lower()) and path.suffix in SUFFIXES and path.is_file()
    ]
    # Of SqueezeNet and MobileNetV2 torchvision's files are of no use here, and archives are.
    return min(found, key=lambda path: path.suffix != ".npz", default=None)


def weights_folders() -> tuple[Path, ...]:
    """Return where published weights are looked for, the user's own folder last."""
    named = os.environ.get(FOLDER_VARIABLE)
    folders = (Path(named),) if named else ()
    try:
        return *folders, cache_folder() / "weights"
    except LoopcloseError:  # without a home there is no folder of one's own
        return folders


def download_pretrained(trunk: Trunk, folder: Path | None = None, url: str | None = None) -> Path:
    """Return the file of a trunk's published weights, downloaded once into a folder.

    Its name ends in the first digits of its SHA-256, which what arrives must have.

    Args:
        trunk: a trunk whose publishers offer a download.
        folder: default: `loopclose/weights` in the user's cache folder.
        url: a mirror; default: the publisher's.

    Raises:
        RecognizerError: there is no download, it fails, or what arrives is not what was published.
    """
    url = url or trunk.url
    digits = re.search(r"-([0-9a-f]{8,64})\.\w+$", url or "")
    if url is None or digits is None:
        raise RecognizerError(f"there is no checked download of weights for {trunk.name!r}")
    path = (folder or cache_folder() / "weights") / url.rsplit("/", 1)[1]
    if path.is_file():
        return path
    try:
        request = urllib.request.Request(url, headers={"User-Agent": "loopclose"})
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as response:
            content: bytes = response.read(MOST_WEIGHTS_BYTES)
    except (OSError, ValueError, http.client.HTTPException) as error:
        raise RecognizerError(f"the weights cannot be downloaded: {error}: {url}") from error
    digest = hashlib.sha256(content).hexdigest()
    if not digest.startswith(digits[1]):
        raise RecognizerError(
            f"the download is damaged: its SHA-256 begins {digest[: len(digits[1])]}, "
            f"not {digits[1]}; try again: {url}"
        )
    make_folder(path.parent)
    write_atomically(path, content)
    return path


def read_weights(path: Path) -> Mapping[str, Tensor]:
    """Return the named tensors of a file of weights; of a checkpoint, those of its state dict.

    Raises:
        RecognizerError: the file cannot be read, is damaged, or would run code.
    """
    content = read_bytes(path, MOST_WEIGHTS_BYTES, what="the weights", kind=RecognizerError)
    try:
        if path.suffix == ".npz":
            return {name: torch.from_numpy(array) for name, array in arrays_of(content).items()}
        if path.suffix == ".caffemodel":
            arrays = read_caffemodel(content)
            return {name: torch.from_numpy(array) for name, array in arrays.items()}
        if path.suffix == WEIGHTS_SUFFIX:
            return safetensors.torch.load(content)
        with torch.serialization.safe_globals(_NUMBERS):
            loaded = load_pickle(content)
    except Exception as error:  # torch and numpy raise many kinds for a damaged file
        what = "the weights file is damaged, or a pickle that would run code"
        raise RecognizerError(f"{what}: {path}") from error
    if isinstance(loaded, Mapping) and isinstance(nested := loaded.get("state_dict"), Mapping):
        loaded = {str(name).replace("module.", ""): value for name, value in nested.items()}
    if not isinstance(loaded, Mapping) or not all(
        isinstance(name, str) and isinstance(value, Tensor) for name, value in loaded.items()
    ):
        raise RecognizerError(f"the weights file does not hold named tensors: {path}")
    return loaded


def load_pickle(content: bytes) -> Any:
    """Return what torch saved, without running code, and only if it is as large as its file.

    Raises:
        Exception: of many kinds; it is damaged, would run code, or is a bomb.
    """
    check_zip(content)
    # What torch has to say about the pickle of a file that it refuses, our errors say.
    with warnings.catch_warnings(action="ignore"):
        return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)


def make_folder(folder: Path) -> None:
    """Make a folder and those it lies in.

    Raises:
        RecognizerError: it cannot be made.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecognizerError(f"cannot make the folder: {error.strerror}: {folder}") from error
