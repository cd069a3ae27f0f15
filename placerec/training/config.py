# SPDX-License-Identifier: Apache-2.0
"""The settings of a training; where the paper gives a value, it is the default."""

from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

from pydantic import BaseModel, ConfigDict, Field

from placerec.training.image_sets import GAMMA, GAMMA_PRIME, NEGATIVES, POSITIVES, SetRules
from placerec.training.images import Augmentation
from placerec.training.losses import ALPHA, BETA


@dataclass(frozen=True)
class TrainingPlan:
    """A network, what it starts from, and how it is trained."""

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
    loss: str = "multi-constraint"
    """What is minimised: multi-constraint, multi-constraint-full or triplet."""
    alpha: float = 0.5
    """Margin between positives and negatives; 0.5 is the paper's."""
    beta: float = 0.3
    """Margin between the positives' spread and two negatives' distance; 0.3 is the paper's."""
    gamma_prime: float = 0.4
    """Squared distance below which a negative is learned from; 0.4 is the paper's."""
    scenes_per_round: int | None = None
    """Recordings of DATA that are visited per round, drawn anew each time; none: all."""
    places_per_scene: int | None = None
    """Places of each that are looked at per round, drawn anew each time; none: all."""
    images_per_place: int = 8
    """Images of each place that are looked at per round, drawn anew each time."""
    batch_sets: int = 5
    """Image sets per step."""
    steps: int | None = None
    """Steps after which the training ends; none: when all places are told apart. With 0 the trunk
    stays what it is, and the fully connected layer is made anew."""
    minutes: float | None = None
    """Time after which the training ends, resumed parts added up; none: no such limit."""
    learning_rate: float = 1e-4
    """Of the fully connected layer."""
    trunk_learning_rate: float = 1e-5
    """Of the layers before it."""
    frozen_block: str | None = None
    """The trunk stays as it is up to the end of this block; none: all layers are trained."""
    augment: bool = True
    """Turn, crop, blur and relight the images of each step, as a hand-held camera would."""
    mixed_precision: bool = False
    """Multiply in bfloat16 on a CPU too, as on a GPU always: faster where the CPU knows how."""
    seed: int = 0
    """What all draws come from."""


class Loss(StrEnum):
    """What is minimised."""

    SIMPLIFIED = "multi-constraint"
    FULL = "multi-constraint-full"
    TRIPLET = "triplet"


class TrainingConfig(BaseModel):
    """How a network is trained."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    loss: Loss = Loss.SIMPLIFIED
    """The paper's loss by its farthest positive and nearest negative (eq. 7) or by all of them
    (eq. 6), or the triplet loss (eq. 2) on the same sets, to compare with."""
    alpha: float = Field(default=ALPHA, ge=0.0)
    """Margin between positives and negatives."""
    beta: float = Field(default=BETA, ge=0.0)
    """Margin between the positives' spread and the distance of two negatives."""
    gamma: float = Field(default=GAMMA, ge=0.0)
    """Squared distance to the centre above which a positive is learned from."""
    gamma_prime: float = Field(default=GAMMA_PRIME, ge=0.0)
    """Squared distance to the centre below which a negative is learned from."""
    positives: int = Field(default=POSITIVES, ge=1)
    """Images of the same place in a set."""
    negatives: int = Field(default=NEGATIVES, ge=2)
    """Images of other places in a set."""
    batch_sets: int = Field(default=5, ge=1)
    """Sets per step, over all processes together."""
    images_per_place: int | None = Field(default=8, ge=1)
    """Images of each place that are looked at per round, drawn anew each time; none: all."""
    scenes_per_round: int | None = Field(default=None, ge=1)
    """Rooms or recordings that are visited per round, drawn anew each time; none: all."""
    places_per_scene: int | None = Field(default=None, ge=2)
    """Places of each that are looked at per round, drawn anew each time; none: all."""
    learning_rate: float = Field(default=1e-4, gt=0.0)
    """Of the fully connected layer."""
    trunk_learning_rate: float = Field(default=1e-5, ge=0.0)
    """Of the layers before it."""
    frozen_block: str | None = None
    """The trunk stays as it is up to the end of this block; none: all layers are trained."""
    augmentation: Augmentation | None = None
    """Changes made to the images of a step; none: what frozen layers see is worked out once."""
    mixed_precision: bool = False
    """Multiply in bfloat16 on a CPU too, as on a GPU always: faster where the CPU knows how."""
    max_steps: int | None = Field(default=None, ge=0)
    """The training ends after so many steps; the learning rates fall to zero along a cosine."""
    max_seconds: float | None = Field(default=None, gt=0.0)
    """The training ends after this time, resumed parts added up."""
    checkpoint_interval_s: float = Field(default=180.0, ge=0.0)
    """Time between two checkpoints."""
    seed: int = Field(default=0, ge=0)
    """What all draws come from."""

    @property
    def rules(self) -> SetRules:
        """How image sets are built."""
        return SetRules(self.gamma, self.gamma_prime, self.positives, self.negatives)
