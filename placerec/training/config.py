# SPDX-License-Identifier: Apache-2.0
"""The settings of a training; where the paper gives a value, it is the default."""

from collections.abc import Callable
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Self

from pydantic import ConfigDict, Field, GetPydanticSchema, ValidationError, model_validator
from pydantic.dataclasses import dataclass

from placerec.errors import RecognizerError
from placerec.training.image_sets import GAMMA_PRIME, SetRules

_MOST = 1_000_000


class Loss(StrEnum):
    """What is minimised: eq. 7, eq. 6, or eq. 2 on the same sets, to compare with."""

    SIMPLIFIED = "multi-constraint"
    FULL = "multi-constraint-full"
    TRIPLET = "triplet"


@dataclass(
    frozen=True,
    config=ConfigDict(extra="forbid", populate_by_name=True, use_enum_values=True),
)
class TrainingConfig:
    """A network, what it starts from, and how it is trained: also the flags of `placerec train`.

    `Training` is given a network; of this, it asks only what comes after `random_last_layer`.

    Raises:
        RecognizerError: a value is not allowed.
    """

    trunk: str = "mobilenet_v2"
    """Convolutions: alexnet, vgg16, squeezenet or mobilenet_v2."""
    block: str | None = None
    """The trunk's last block to keep; none: all of it."""
    grid: tuple[int, int] | None = None
    """Rows and columns of cells to average the trunk's maps in; none: keep them whole."""
    covariance: bool = False
    """Describe the maps by how their channels vary together, not by their values."""
    words: int | None = None
    """Describe the maps by how they differ from so many words (NetVLAD; the paper's has 64)."""
    size: tuple[int, int] | None = None
    """Width and height that images are resized to, in pixels; none: the trunk's."""
    dimension: int = 1000
    """Values in an embedding."""
    weights: Path | None = None
    """What the trunk starts from: its published weights, .pth or .npz, or those of an earlier
    training, .safetensors; none: random ones."""
    random_last_layer: bool = False
    """Start the fully connected layer from random weights, as the paper does, not from whitened
    principal components of what the trunk makes of DATA."""
    # A string to tyro, so that errors about it are told as all others are.
    loss: Annotated[str, GetPydanticSchema(lambda _, schema: schema(Loss))] = Loss.SIMPLIFIED.value
    """What is minimised: multi-constraint, multi-constraint-full or triplet."""
    alpha: float = Field(default=0.5, ge=0.0, le=_MOST)
    """Margin between positives and negatives; 0.5 is the paper's."""
    beta: float = Field(default=0.3, ge=0.0, le=_MOST)
    """Margin between the positives' spread and two negatives' distance; 0.3 is the paper's."""
    gamma_prime: float = Field(default=GAMMA_PRIME, ge=0.0, le=_MOST)
    """Squared distance below which a negative is learned from; 0.4 is the paper's."""
    scenes_per_round: int | None = Field(default=None, ge=1, le=_MOST)
    """Recordings of DATA that are visited per round, drawn anew each time; none: all."""
    places_per_scene: int | None = Field(default=None, ge=2, le=_MOST)
    """Places of each that are looked at per round, drawn anew each time; none: all."""
    images_per_place: int = Field(default=8, ge=1, le=_MOST)
    """Images of each place that are looked at per round, drawn anew each time."""
    batch_sets: int = Field(default=5, ge=1, le=1000)
    """Image sets per step."""
    steps: int | None = Field(default=None, ge=0, le=10**9, alias="max_steps")
    """Steps after which the training ends; none: when all places are told apart. With 0 the trunk
    stays what it is, and the fully connected layer is made anew."""
    minutes: float | None = Field(default=None, gt=0.0, allow_inf_nan=False)
    """Time after which the training ends, resumed parts added up; none: no such limit."""
    learning_rate: float = Field(default=1e-4, gt=0.0, allow_inf_nan=False)
    """Of the fully connected layer."""
    trunk_learning_rate: float = Field(default=1e-5, ge=0.0, allow_inf_nan=False)
    """Of the layers before it."""
    frozen_block: str | None = None
    """The trunk stays as it is up to the end of this block; none: all layers are trained."""
    augment: bool = False
    """Turn, crop, blur and relight the images of each step, as a hand-held camera would."""
    mixed_precision: bool = False
    """Multiply in bfloat16 on a CPU too, as on a GPU always: faster where the CPU knows how."""
    seed: int = Field(default=0, ge=0, lt=1 << 63)
    """What all draws come from."""

    @model_validator(mode="wrap")
    @classmethod
    def _in_one_line(cls, values: object, validate: Callable[[object], Self]) -> Self:
        try:
            return validate(values)
        except ValidationError as error:
            first = error.errors()[0]
            name, why = first["loc"][0], first["msg"]
            what = f"{name} = {first['input']!r}: {why[0].lower()}{why[1:]}"
            raise RecognizerError(what) from error

    @property
    def rules(self) -> SetRules:
        """How image sets are built."""
        return SetRules(gamma_prime=self.gamma_prime)
