# SPDX-License-Identifier: Apache-2.0
"""What a baseline has learned from images without labels, such as a mean: kept as one file."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors.numpy
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open

from placerec.output_file import write_atomically
from placerec.recognizer import RecognizerError
from placerec.user_cache import cache_folder

METADATA_KEY = "placerec"
SUFFIX = ".safetensors"
SHIPPED = Path(__file__).parents[1] / "weights"


@dataclass(frozen=True)
class Fitted:
    """What was learned, and from what.

    Attributes:
        arrays: by name.
        facts: whatever else must be known to use them, such as the layer that they belong to.
        data: the images they were learned from, "" before that is known.
    """

    arrays: Mapping[str, NDArray[np.float32]]
    facts: Mapping[str, str]
    data: str = ""

    @property
    def fingerprint(self) -> str:
        """Changes whenever what was learned does."""
        digest = hashlib.sha256(repr(sorted(self.facts.items())).encode())
        for key, array in sorted(self.arrays.items()):
            digest.update(f"{key} {array.shape}".encode())
            digest.update(array.astype(np.float32).tobytes())
        return f"sha256:{digest.hexdigest()}"


def write_fitted(name: str, fitted: Fitted, folder: Path | None = None) -> Path:
    """Write what a baseline has learned, in half precision, by default where it is found again.

    Raises:
        RecognizerError: the file cannot be written.
    """
    folder = fitted_folder() if folder is None else folder
    tensors = {key: np.asarray(array, np.float16) for key, array in fitted.arrays.items()}
    facts = json.dumps({"facts": dict(fitted.facts), "data": fitted.data}, sort_keys=True)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecognizerError(f"cannot make the folder: {error.strerror}: {folder}") from error
    path = folder / f"{name}{SUFFIX}"
    write_atomically(path, safetensors.numpy.save(tensors, {METADATA_KEY: facts}))
    return path


def read_fitted(name: str, shipped: Path = SHIPPED) -> Fitted:
    """Return what a baseline has learned on this machine, or else what comes with the package.

    Raises:
        RecognizerError: there is neither, or the file is damaged.
    """
    files = [folder / f"{name}{SUFFIX}" for folder in (fitted_folder(), shipped)]
    path = next((file for file in files if file.is_file()), None)
    if path is None:
        raise RecognizerError(
            f"{name} has to see images first: placerec fit {name} FOLDER, which writes {files[0]}"
        )
    try:
        with safe_open(path, framework="numpy") as file:
            known = json.loads((file.metadata() or {})[METADATA_KEY])
            keys = file.keys()
            arrays = {key: file.get_tensor(key).astype(np.float32) for key in keys}
        return Fitted(arrays, dict(known["facts"]), str(known["data"]))
    except (OSError, SafetensorError, KeyError, ValueError) as error:
        raise RecognizerError(
            f"the file cannot be used; fit {name} anew with placerec fit, or remove it: {path}"
        ) from error


def fitted_folder() -> Path:
    """Return where `placerec fit` writes to."""
    return cache_folder() / "fitted"
