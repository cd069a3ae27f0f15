# SPDX-License-Identifier: Apache-2.0
"""`placerec train`: learn to tell the places of some images apart."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import tyro

from placerec.commands.console import progress_bar, say
from placerec.commands.data import Data, with_skipped_named
from placerec.datasets import LabelledImages, open_collection
from placerec.errors import RecognizerError, deferred_interrupts
from placerec.training.config import TrainingConfig

_DEFAULTS = TrainingConfig(augment=True)


def train(
    data: Data,
    /,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")],
    training: Annotated[TrainingConfig, tyro.conf.OmitArgPrefixes] = _DEFAULTS,
) -> int:
    """Train a recognizer on images of known places, or go on with it.

    Example: placerec train ie_tower --out runs/tower --weights mobilenet_v2.npz --minutes 60

    The same command goes on with a training that was stopped. --help-all lists what can be set.

    DIR then holds weights.safetensors, whose path names the recognizer from then on, log.csv and
    log.png. Measure and calibrate it on other images than these.

    Args:
        data: folders in the formats of evaluate, or of such folders; of clips, the floors for
            training. At each recording drawn for a round, each of them has the same chance, and the
            fully connected layer starts from as many images of each.
        out: folder for the results and the checkpoint.
        training: what is trained, and how.
    """
    # Loaded here, because torch takes seconds that the other commands do not need.
    from placerec.training.run import start_training, write_results
    from placerec.training.workers import Workers

    if not data:
        raise RecognizerError("train needs at least one folder of images; see --help")
    collections = [
        [with_skipped_named(dataset) for dataset in open_collection(source, "train")]
        for source in data
    ]
    images, workers = LabelledImages(*collections), Workers()
    with (
        deferred_interrupts() as interrupted,
        progress_bar("training", training.steps, "step", is_shown=workers.is_first) as progress,
    ):

        def show(done: int, what: str) -> None:
            progress(done, what=what)
            if interrupted.is_set():
                raise KeyboardInterrupt

        def look(done: int, total: int | None) -> None:
            show(0, f"looking at image {done} of {total}")

        try:
            started = start_training(training, images, out, workers, look)
            # Closed, it writes its checkpoint at once.
            with closing(iter(started)) as records:
                for record in records:
                    show(
                        record.step,
                        f"loss {record.loss:.3f}, {record.sets_left} sets left, "
                        f"{record.images_per_s:.0f} images/s, "
                        f"{record.time_to_go_s / 60:.1f} min to go",
                    )
        except KeyboardInterrupt:
            raise RecognizerError(f"stopped; the same command goes on from here: {out}") from None
    if workers.is_first:
        path = write_results(started, training, out)
        skipped = sum(len(dataset.skipped) for each in collections for dataset in each)
        say(
            f"the training is over: {started.end}\n"
            f"learned from {len(images)} images ({skipped} skipped)\n"
            f"written to {path}, not calibrated yet"
        )
    return 0
