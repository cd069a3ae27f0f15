# SPDX-License-Identifier: Apache-2.0
"""`placerec fit`: learn from images without labels what a recognizer needs before it works."""

from collections.abc import Iterable, Iterator
from itertools import chain
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray

from placerec.commands.data import open_images, progress_bar
from placerec.embedded_images import Progress
from placerec.fitted_file import FittedRecognizer
from placerec.recognizer import WEIGHTS_SUFFIX, RecognizerError, load


def fit(
    name: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME|MODULE:CLASS|FILE")],
    data: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="DATA ...")],
    /,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    seed: int = 0,
) -> int:
    """Learn a recognizer's vocabulary or the like from images; nobody has to label them.

    Example: placerec fit bag-of-words path/to/images --out words.safetensors

    The file then names the recognizer: run_slam demo --recognizer words.safetensors

    Args:
        name: a recognizer that learns from images in this way.
        data: folders of images, or in the formats of evaluate; of clips, the floors for training.
        out: what to write, a name that ends in .safetensors; default: NAME.safetensors, here.
        seed: what all draws come from.
    """
    path = Path(f"{Path(name).stem}{WEIGHTS_SUFFIX}") if out is None else out
    if path.suffix != WEIGHTS_SUFFIX or not data:
        what = "at least one folder of images" if not data else f"a name in {WEIGHTS_SUFFIX}"
        raise RecognizerError(f"fit needs {what}; see --help: {path}")
    recognizer = load(name)
    if not isinstance(recognizer, FittedRecognizer):
        raise RecognizerError(f"recognizer {name!r} has nothing to learn from images alone")
    datasets = [open_images(source) for source in data]
    count = sum(len(dataset) for dataset in datasets)
    with progress_bar(f"fitting {name}", count) as progress:
        recognizer.fit(_counted(chain(*datasets), count, progress), seed)
    recognizer.trained_on = tuple(dataset.name for dataset in datasets)
    recognizer.save(path)
    print(f"learned from {count} images\nwritten to {path}, not calibrated on them")
    return 0


def _counted(
    images: Iterable[NDArray[np.uint8]], count: int, progress: Progress
) -> Iterator[NDArray[np.uint8]]:
    for done, image in enumerate(images, 1):
        yield image
        progress(done, count)
