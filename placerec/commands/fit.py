# SPDX-License-Identifier: Apache-2.0
"""`placerec fit`: let a built-in method look at images before it recognises places."""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from importlib.metadata import entry_points
from pathlib import Path
from typing import Annotated, cast

import numpy as np
import tyro
from numpy.typing import NDArray

from placerec.baselines.fitted import Fitted, write_fitted
from placerec.commands.data import open_data, progress_bar
from placerec.datasets.images import BrokenImage, images_in, read_image
from placerec.embedded_images import Progress
from placerec.recognizer import ENTRY_POINT_GROUP, RecognizerError

Image = NDArray[np.uint8]


def fit(
    recognizer: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")],
    data: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")],
    /,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
) -> int:
    """Let a built-in method look at images, as far as it must before it recognises places.

    Example: placerec fit r-mac path/to/photographs

    What it learns, such as a mean or a dictionary of words, is kept on this machine and goes before
    what comes with the package.

    Args:
        recognizer: installed name of a method that has something to fit.
        data: a folder of images, or one in the formats of train; labels are not looked at.
        out: folder to write NAME.safetensors to instead.
    """
    learn = _fit_of(recognizer)
    paths, title = _images_of(data)
    with progress_bar(f"fitting {recognizer}", len(paths)) as progress:
        fitted = learn(_read(paths, progress))
    path = write_fitted(recognizer, replace(fitted, data=title), out)
    print(f"{recognizer} was fitted to {len(paths)} images of {title}\nwritten to {path}")
    return 0


def _fit_of(name: str) -> Callable[[Iterable[Image]], Fitted]:
    entries = entry_points(group=ENTRY_POINT_GROUP, name=name)
    try:
        found = [getattr(entry.load(), "fit", None) for entry in entries]
    except Exception as error:
        why = " ".join(f"{type(error).__name__}: {error}".split())
        raise RecognizerError(f"recognizer {name!r} cannot be imported: {why}") from error
    if len(found) != 1 or found[0] is None:
        raise RecognizerError(f"there is nothing to fit in a recognizer {name!r}")
    return cast(Callable[[Iterable[Image]], Fitted], found[0])


def _images_of(data: str) -> tuple[list[Path], str]:
    """Return the images of a folder, or of a dataset's part for training, and what to call it."""
    folder = Path(data)
    if folder.is_dir() and (paths := images_in(folder)):
        return paths, folder.resolve().name
    dataset = open_data(data, "train")
    return list(dataset.paths), dataset.name


def _read(paths: list[Path], progress: Progress) -> Iterator[Image]:
    for done, path in enumerate(paths, 1):
        image = read_image(path)
        if isinstance(image, BrokenImage):
            raise RecognizerError(f"{image.why}; remove it: {image.path}")
        yield image
        progress(done, len(paths))
