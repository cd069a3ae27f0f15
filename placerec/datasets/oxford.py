# SPDX-License-Identifier: Apache-2.0
"""New College and City Centre as their authors publish them (Cummins and Newman 2008)."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from placerec.datasets.images import images_in
from placerec.datasets.mat_file import read_mat
from placerec.datasets.place_dataset import PlaceDataset, check_images, keep_readable
from placerec.errors import RecognizerError
from placerec.files import read_bytes

_GROUND_TRUTH = "*GroundTruth.mat"
_VARIABLE = "truth"
_MIN_GAP_IMAGES = 10
"""Images closer in order are not compared: at a left and a right one every 1.5 m, up to 7.5 m
apart on one drive; the authors' matrix marks revisits only."""


def find_ground_truth(folder: Path) -> Path | None:
    """Return the matrix file of such a folder, None where there is none."""
    found = sorted([*folder.glob(_GROUND_TRUTH), *folder.glob(f"masks/{_GROUND_TRUTH}")])
    return next((file for file in found if not file.name.startswith(".")), None)


def read_oxford(folder: Path) -> PlaceDataset:
    """Read a folder with the images in Images/ and the matrix in a file ...GroundTruth.mat.

    The matrix (`truth`, images x images) is 1 where two images show the same place. Only its lower
    triangle is filled by the authors, so either of (i, j) and (j, i) counts.
    """
    file, images = find_ground_truth(folder), folder / "Images"
    if file is None or not images.is_dir():
        missing = "folder Images" if file else f"file {_GROUND_TRUTH}"
        raise RecognizerError(f"there is no {missing}: {folder}")
    paths = images_in(images)
    check_images(paths, folder.resolve().name)
    truth = _read_matrix(file)
    if truth.shape != (len(paths), len(paths)):
        raise RecognizerError(
            f"the ground truth is a matrix of {truth.shape[0]} x {truth.shape[1]}, but there are "
            f"{len(paths)} images in {images.name}: {file}"
        )
    everyone = np.arange(len(paths))
    dataset = PlaceDataset(
        name=folder.resolve().name,
        paths=tuple(paths),
        queries=everyone,
        references=everyone,
        same_place=truth | truth.T,
        comparable=np.abs(everyone[:, None] - everyone) > _MIN_GAP_IMAGES,
    )
    return keep_readable(dataset)


def _read_matrix(file: Path) -> NDArray[np.bool_]:
    content = read_bytes(file, kind=RecognizerError)
    try:
        matrix = read_mat(content, _VARIABLE)
    except ValueError as error:
        raise RecognizerError(
            f"{file.name} is no MATLAB file of version 5 to 7 ({error}); save it with -v7: {file}"
        ) from error
    if matrix is None or matrix.ndim != 2:
        raise RecognizerError(f"{file.name} has no matrix {_VARIABLE!r}: {file}")
    return np.asarray(matrix != 0)
