# SPDX-License-Identifier: Apache-2.0
"""Images and which pairs of them show the same place: one file per format."""

from placerec.datasets.formats import open_dataset
from placerec.datasets.place_dataset import PlaceDataset

__all__ = ["PlaceDataset", "open_dataset"]
