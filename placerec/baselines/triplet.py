# SPDX-License-Identifier: Apache-2.0
"""The default's twin, trained with the triplet loss: what the paper compares its own loss with."""

from pathlib import Path

from placerec.embedding import TRAINED_ON, LearnedRecognizer
from placerec.recognizer import RecognizerError

TRIPLET_WEIGHTS = Path(__file__).parents[1] / "weights" / "triplet.safetensors"


class Triplet(LearnedRecognizer):
    """The default network, trained with eq. 2 on the same images for as many steps.

    Attributes:
        min_similarity: cosine from which a match is worth verifying, stored with the weights.
    """

    def __init__(self, path: Path = TRIPLET_WEIGHTS) -> None:
        """Read the weights.

        Raises:
            RecognizerError: they are missing, are damaged, or do not fit.
        """
        if not path.exists():
            raise RecognizerError(
                "the default network's twin is not installed; make it with `python"
                f" benchmarks/train_default.py --loss triplet --ship`: {path}"
            )
        super().__init__(path)
        self.weights = f"{self.network.title}, trained as the default but with the triplet loss"
        self.trained_on = TRAINED_ON
