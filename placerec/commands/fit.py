# SPDX-License-Identifier: Apache-2.0
"""`placerec fit`: learn from images without labels what a recognizer needs before it works."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import tyro
from numpy.typing import NDArray

from placerec.commands.console import progress_bar, say
from placerec.commands.data import Data, open_images
from placerec.datasets import PlaceDataset
from placerec.errors import RecognizerError, cause_of
from placerec.files import Progress
from placerec.recognizer import WEIGHTS_SUFFIX, find, imported
from placerec.recognizers.fitted_file import Fitted, write_fitted

Fit = Callable[[Sequence[NDArray[np.uint8]], int], Fitted]
"""A class method: it takes (H, W, 3) uint8 RGB images, decoded when they are asked for, and a seed.

The recognizer's constructor takes the path of what `write_fitted` makes of the answer.
"""


def fit(
    recognizer: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME")],
    data: Data,
    /,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    seed: int = 0,
) -> int:
    """Learn what a recognizer needs from images that nobody labelled.

    Example: placerec fit bag-of-words path/to/images --out words.safetensors

    The file then names the recognizer: run_slam demo --recognizer words.safetensors. Calibrate it
    on other images.

    Args:
        recognizer: installed name of one that learns from images in this way.
        data: folders of images, or in the formats of evaluate; of clips, the floors for training.
        out: what to write, a name that ends in .safetensors; default: NAME.safetensors, here.
        seed: what all draws come from.
    """
    path = Path(f"{recognizer}{WEIGHTS_SUFFIX}") if out is None else out
    # All that may be wrong with what was asked is found before the long work.
    _refuse(recognizer, data, path, seed)
    made = imported(find(recognizer), f"recognizer {recognizer!r}")
    learn = cast(Fit | None, getattr(made, "fit", None))
    if learn is None:
        raise RecognizerError(f"recognizer {recognizer!r} has nothing to learn from images alone")
    datasets = [open_images(source, "train") for source in data]
    count = sum(map(len, datasets))
    with progress_bar(f"fitting {recognizer}", count) as progress:
        try:
            fitted: object = learn(_Images(datasets, progress), seed)
        except RecognizerError:
            raise
        except Exception as error:
            why = cause_of(error)
            raise RecognizerError(f"recognizer {recognizer!r} failed to learn: {why}") from error
    if not isinstance(fitted, Fitted):
        kind = type(fitted).__name__
        raise RecognizerError(f"recognizer {recognizer!r} learned a {kind}; fit returns a Fitted")
    names = tuple(dataset.name for dataset in datasets)
    threshold: Any = getattr(made, "min_similarity", None)
    write_fitted(path, recognizer, replace(fitted, trained_on=names, min_similarity=threshold))
    say(f"learned from {count} images of {', '.join(names)}\nwritten to {path}, not calibrated")
    return 0


def _refuse(recognizer: str, data: Sequence[str], out: Path, seed: int) -> None:
    for is_wrong, what in (
        (":" in recognizer, "an installed NAME, for a file must not name code to run"),
        (out.suffix != WEIGHTS_SUFFIX, f"a FILE that ends in {WEIGHTS_SUFFIX}"),
        (not out.parent.is_dir(), "a FILE in a folder that is there"),
        (not data, "at least one folder of images"),
        (seed < 0, f"a seed that is not negative, as {seed} is"),
    ):
        if is_wrong:
            raise RecognizerError(f"fit needs {what}; see --help: {out}")


class _Images(Sequence[NDArray[np.uint8]]):
    """The images of some datasets, one dataset after the other, decoded when they are asked for."""

    def __init__(self, datasets: Sequence[PlaceDataset], progress: Progress) -> None:
        self._where = [(dataset, i) for dataset in datasets for i in range(len(dataset))]
        self._progress = progress

    def __len__(self) -> int:
        return len(self._where)

    def __getitem__(self, index: Any, /) -> Any:
        dataset, i = self._where[index]
        self._progress(index + 1, len(self))
        return dataset[i]
