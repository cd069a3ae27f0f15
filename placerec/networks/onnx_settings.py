# SPDX-License-Identifier: Apache-2.0
"""What an ONNX network must be told with, by its metadata and by a TOML file beside it."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from placerec.errors import RecognizerError
from placerec.files import is_file, read_toml

METADATA_KEY = "placerec"

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


def settings_path(path: Path) -> Path:
    """Return where the settings of a network would be."""
    return path.with_suffix(".toml")


def read_settings(metadata: Mapping[str, str], path: Path) -> OnnxSettings:
    """Return what the metadata say, and a TOML file beside the network, which wins.

    Raises:
        RecognizerError: either cannot be read or says what cannot be used.
    """
    try:
        known = json.loads(metadata.get(METADATA_KEY, "{}"))
    except ValueError as error:
        raise RecognizerError(
            f"the metadata {METADATA_KEY!r} of the network are not JSON: {error}: {path}"
        ) from error
    if not isinstance(known, dict):
        raise RecognizerError(f"the metadata {METADATA_KEY!r} are no names and values: {path}")
    told, beside = _validated(known, path), settings_path(path)
    if not is_file(beside):
        return told
    return _validated(known | read_toml(beside, kind=RecognizerError), beside)


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
