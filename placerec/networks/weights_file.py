# SPDX-License-Identifier: Apache-2.0
"""A trained network as one safetensors file that says how to rebuild it."""

import hashlib
from collections.abc import Iterable
from pathlib import Path

import safetensors.torch
import torch
from pydantic import BaseModel, ConfigDict, Field
from safetensors import SafetensorError, safe_open
from torch import Tensor, nn

from placerec.errors import RecognizerError
from placerec.files import MOST_WEIGHTS_BYTES, check_file, write_atomically
from placerec.networks import TRUNKS, PlaceNetwork, Trunk

_METADATA_KEY = "placerec"
_LAST_LAYER = "fully_connected.weight"


class _Description(BaseModel):
    model_config = ConfigDict(extra="forbid")

    trunk: str
    block: str | None
    grid: tuple[int, int] | None
    covariance: bool = False
    words: int | None = None
    size_px: tuple[int, int]
    min_similarity: float = Field(ge=-1.0, le=1.0)


def save_weights(network: PlaceNetwork, path: Path, min_similarity: float) -> None:
    """Write a network and its threshold, in half precision; the same network, the same bytes.

    `min_similarity` is the cosine from which a match is worth verifying. An earlier file is
    replaced as a whole.

    Raises:
        RecognizerError: a weight is not finite in half precision, or the file cannot be written.
    """
    description = _Description(
        trunk=network.trunk.name,
        block=network.block,
        grid=network.grid,
        covariance=network.covariance,
        words=network.words,
        size_px=(network.preprocessing.width_px, network.preprocessing.height_px),
        min_similarity=min_similarity,
    )
    _write(path, description, {n: _half(n, value) for n, value in network.state_dict().items()})


def load_weights(
    path: Path, trunks: Iterable[Trunk] = tuple(TRUNKS.values())
) -> tuple[PlaceNetwork, float]:
    """Return the network that a file holds, and its min_similarity.

    Args:
        path: a file written by `save_weights`.
        trunks: the trunks it may be made with; a network with a trunk of one's own needs it here.

    Raises:
        RecognizerError: the file cannot be read, is damaged, is a pickle, or does not fit its own
            description.
    """
    description, tensors = _read(path)
    known = {trunk.name: trunk for trunk in trunks}
    if description.trunk not in known:
        raise RecognizerError(
            f"the weights are for trunk {description.trunk!r}, which is not among "
            f"{', '.join(known)}: {path}"
        )
    try:
        # The last layer is made once it is known to be no larger than the file says.
        network = PlaceNetwork(
            known[description.trunk],
            1,
            **description.model_dump(exclude={"trunk", "min_similarity"}),
        )
        dimension, values = tensors[_LAST_LAYER].shape
        if values != (made := network.fully_connected.in_features):
            raise RecognizerError(f"{_LAST_LAYER} takes {values} values, not {made}")
        with torch.random.fork_rng():
            network.fully_connected = nn.Linear(values, dimension)
        network.load_state_dict(tensors)
    except (RuntimeError, RecognizerError) as error:
        what = " ".join(str(error).split())
        raise RecognizerError(f"the weights do not fit their network: {what}: {path}") from error
    return network.eval(), description.min_similarity


def set_min_similarity(path: Path, min_similarity: float) -> None:
    """Write another threshold into a file of weights, which is replaced as a whole.

    Raises:
        RecognizerError: the file cannot be read, is damaged, is a pickle, or cannot be written.
    """
    description, tensors = _read(path)
    _write(path, description.model_copy(update={"min_similarity": min_similarity}), tensors)


def hash_network(network: PlaceNetwork) -> str:
    """Return "sha256:..." of all that embeddings depend on: the tensors and the input's making."""
    cut = network.trunk.name, network.block, network.grid, network.covariance
    digest = hashlib.sha256(repr((*cut, network.preprocessing)).encode())
    for name, value in sorted(network.state_dict().items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode())
        digest.update(value.cpu().contiguous().numpy().tobytes())
    return f"sha256:{digest.hexdigest()}"


def _read(path: Path) -> tuple[_Description, dict[str, Tensor]]:
    check_file(path, MOST_WEIGHTS_BYTES, what="the weights", kind=RecognizerError)
    try:
        with safe_open(path, framework="pt") as file:
            metadata = file.metadata() or {}
            tensors = {name: file.get_tensor(name) for name in list(file.keys())}
    except OSError as error:
        why = error.strerror or str(error)
        raise RecognizerError(f"cannot read the weights: {why}: {path}") from error
    except SafetensorError as error:
        raise RecognizerError(
            f"the weights are not a whole safetensors file ({error}); a pickle is never opened: "
            f"{path}"
        ) from error
    try:
        description = _Description.model_validate_json(metadata[_METADATA_KEY])
        last_layer = tensors[_LAST_LAYER]
    except (KeyError, ValueError) as error:  # of pydantic, too
        raise RecognizerError(f"the weights are not of a place network: {path}") from error
    if last_layer.ndim != 2 or not all(bool(value.isfinite().all()) for value in tensors.values()):
        raise RecognizerError(f"the weights are damaged: some are NaN or infinite: {path}")
    return description, tensors


def _write(path: Path, description: _Description, tensors: dict[str, Tensor]) -> None:
    metadata = {_METADATA_KEY: description.model_dump_json()}
    write_atomically(path, safetensors.torch.save(tensors, metadata))


def _half(name: str, value: Tensor) -> Tensor:
    if not value.is_floating_point():
        return value.cpu().contiguous()
    half = value.detach().to("cpu", torch.float16).contiguous()
    if not half.isfinite().all():
        raise RecognizerError(f"the weights {name} are not finite in half precision; train again")
    return half
