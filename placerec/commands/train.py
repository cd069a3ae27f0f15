# SPDX-License-Identifier: Apache-2.0
"""`placerec train`: learn to tell the places of some images apart."""

from contextlib import closing
from pathlib import Path
from typing import Annotated

import tyro
from tqdm import tqdm

from placerec.commands.data import Data, with_skipped_named
from placerec.datasets import LabelledImages, open_collection
from placerec.errors import RecognizerError, deferred_interrupts
from placerec.training.config import TrainingConfig

_DEFAULTS = TrainingConfig(augment=True)


def train(
    data: Data,
    /,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")],
    config: Annotated[TrainingConfig, tyro.conf.arg(name="")] = _DEFAULTS,
) -> int:
    """Train a recognizer on images of known places; the same command goes on with a stopped one.

    Example: placerec train ie_tower --out runs/tower --weights mobilenet_v2.npz --minutes 60

    DIR then holds weights.safetensors, whose path names the recognizer from then on, log.csv and
    log.png. Measure and calibrate it on other images than these.

    Args:
        data: folders in the formats of evaluate, or of such folders; of clips, the floors for
            training. At each recording drawn for a round, each of them has the same chance, and the
            fully connected layer starts from as many images of each.
        out: folder for the results and the checkpoint.
        config: what is trained, and how.
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
    hidden = None if workers.is_first else True
    with (
        deferred_interrupts() as interrupted,
        tqdm(total=config.steps, desc="training", unit="step", leave=False, disable=hidden) as bar,
    ):

        def show(what: str) -> None:
            bar.set_postfix_str(what)
            if interrupted.is_set():
                raise KeyboardInterrupt

        def look(done: int, total: int | None) -> None:
            show(f"looking at image {done} of {total}")

        try:
            training = start_training(config, images, out, workers, look)
            # Closed, it writes its checkpoint at once.
            with closing(iter(training)) as records:
                for record in records:
                    bar.update(record.step - bar.n)
                    show(
                        f"loss {record.loss:.3f}, {record.sets_left} sets left, "
                        f"{record.images_per_s:.0f} images/s, "
                        f"{record.time_to_go_s / 60:.1f} min to go"
                    )
        except KeyboardInterrupt:
            raise RecognizerError(f"stopped; the same command goes on from here: {out}") from None
    if workers.is_first:
        path = write_results(training, config, out)
        skipped = sum(len(dataset.skipped) for each in collections for dataset in each)
        print(
            f"the training is over: {training.end}\n"
            f"learned from {len(images)} images ({skipped} skipped)\n"
            f"written to {path}, not calibrated yet"
        )
    return 0
