# SPDX-License-Identifier: Apache-2.0
"""Images and which pairs of them show the same place: one file per format."""

from placerec.datasets.formats import open_collection, open_dataset
from placerec.datasets.labelled_images import LabelledImages
from placerec.datasets.place_dataset import PlaceDataset, describe

__all__ = ["LabelledImages", "PlaceDataset", "describe", "open_collection", "open_dataset"]
