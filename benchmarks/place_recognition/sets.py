# SPDX-License-Identifier: Apache-2.0
"""What is measured on: images that no training has seen, in sets of one dataset or several."""

from dataclasses import dataclass
from pathlib import Path

from placerec.datasets import PlaceDataset, open_dataset

DESK, CORRIDOR, FLOORS, RENDERED = "fr1_desk", "corridor", "ie_tower test floors", "rendered rooms"


@dataclass(frozen=True)
class EvaluationSet:
    """Datasets whose figures are averaged."""

    name: str
    datasets: tuple[PlaceDataset, ...]

    @property
    def slug(self) -> str:
        """The name as a part of a file's name."""
        return self.name.replace(" ", "_")


def open_sets(data: Path, validation: Path) -> list[EvaluationSet]:
    """Open all evaluation sets; rendered paths that are not there are left out.

    Raises:
        RecognizerError: a folder is missing or in no known format.
    """
    sources = {
        DESK: [str(data / "rgbd_dataset_freiburg1_desk")],
        CORRIDOR: [str(data / "corridor")],
        FLOORS: [f"{data / 'ie_tower'}:test"],
        RENDERED: sorted(str(path.parent) for path in validation.glob("*/rgb.txt")),
    }
    return [
        EvaluationSet(name, tuple(open_dataset(source) for source in folders))
        for name, folders in sources.items()
        if folders
    ]
