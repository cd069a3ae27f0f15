# SPDX-License-Identifier: Apache-2.0
"""The `placerec` command: one function per sub-command."""

import sys
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

from placerec import calibration, evaluation
from placerec.certificate import Certificate, write_certificate
from placerec.conformance import Report
from placerec.conformance import check as check_recognizer
from placerec.cost import measure_cost
from placerec.datasets import LabelledImages, PlaceDataset, open_dataset
from placerec.evaluation_table import LEGEND, Measured, evaluation_table
from placerec.interruption import deferred_interrupts
from placerec.recognizer import PlaceRecognizer, RecognizerError, available, load
from placerec.training_plan import TrainingPlan

if TYPE_CHECKING:
    from placerec.training import Training

DOES_NOT_CONFORM, BAD_USAGE = 1, 2

DESCRIPTION = "Recognise places: train, check, measure and calibrate what tells them apart."

RECOGNIZER = "NAME|MODULE:CLASS|FILE"

app = tyro.extras.SubcommandApp()


@app.command
def check(
    recognizer: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar=RECOGNIZER)],
    /,
) -> int:
    """Tell what a recognizer does right and wrong.

    Args:
        recognizer: an installed name, package.module:ClassName, or trained weights.
    """
    report = check_recognizer(load(recognizer))
    print(_table(report))
    return 0 if report.passed else DOES_NOT_CONFORM


@app.command
def evaluate(
    data: Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="DATA ...", help_behavior_hint="(at least one)"),
    ],
    /,
    recognizers: Annotated[
        tuple[str, ...],
        tyro.conf.arg(metavar=f"{RECOGNIZER} ...", help_behavior_hint="(default: all installed)"),
    ] = (),
) -> int:
    """Measure how well recognizers tell places apart, and what they cost, as a Markdown table.

    Example: placerec evaluate rgbd_dataset_freiburg1_desk corridor --recognizers gradients

    Args:
        data: folders of images, each in one of these formats:
            - rgb.txt, groundtruth.txt: TUM RGB-D
            - Images/, *GroundTruth.mat: New College, City Centre
            - query/, ref/: two drives of one path
            - dataset.csv: clips; the test floors, or as named
            after a colon, FOLDER:validation or FOLDER:train
        recognizers: installed names, package.module:ClassName, or trained weights.
    """
    if not data:
        raise RecognizerError("evaluate needs at least one folder of images; see --help")
    names = recognizers or available()
    loaded = [(name, load(name)) for name in names]
    rows = []
    for dataset in map(_open, data):
        for name, recognizer in loaded:
            embeddings, embed_s = _embed(name, recognizer, dataset)
            found = evaluation.evaluate(dataset, embeddings)
            rows.append(Measured(dataset.name, name, found, measure_cost(embeddings, embed_s)))
        print(_description(dataset))
    print(f"\n{evaluation_table(rows)}\n\n{LEGEND}")
    return 0


@app.command
def calibrate(
    data: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")],
    /,
    recognizer: Annotated[str, tyro.conf.arg(metavar=RECOGNIZER)],
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")],
) -> int:
    """Find the threshold of a recognizer: the largest recall without an error on some data.

    Example: placerec calibrate ie_tower:validation --recognizer gradients --out gradients.json

    Args:
        data: images not used in training or to choose; formats as in evaluate.
        recognizer: an installed name, package.module:ClassName, or trained weights.
        out: certificate to write beside the weights, as JSON.
    """
    loaded, dataset = load(recognizer), _open(data)
    embeddings, _ = _embed(recognizer, loaded, dataset)
    certificate = calibration.calibrate(recognizer, loaded, dataset, embeddings)
    write_certificate(certificate, out)
    print(f"{_description(dataset)}\n{_summary(certificate)}\nwritten to {out}")
    return 0


@app.command
def train(
    data: Annotated[
        tuple[str, ...],
        tyro.conf.Positional,
        tyro.conf.arg(metavar="DATA ...", help_behavior_hint="(at least one)"),
    ],
    /,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")],
    plan: Annotated[TrainingPlan, tyro.conf.arg(name="")],
) -> int:
    """Train a recognizer on images of known places; the same command goes on with a stopped one.

    Example: placerec train ie_tower --out runs/tower --weights mobilenet_v2.npz --minutes 60

    DIR then holds weights.safetensors, whose path names the recognizer from then on, log.csv and
    log.png. Measure and calibrate it on other images than these.

    Args:
        data: folders in the formats of evaluate; of clips, the floors for training.
        out: folder for the results and the checkpoint.
        plan: what is trained, and how.
    """
    # Loaded here, because torch takes seconds that the other commands do not need.
    from placerec.training_run import start_training, write_results
    from placerec.workers import Workers

    if not data:
        raise RecognizerError("train needs at least one folder of images; see --help")
    images, workers = LabelledImages([_open(source, "train") for source in data]), Workers()
    with deferred_interrupts() as interrupted:
        bar = _TrainingBar(plan.steps, interrupted, is_shown=workers.is_first)
        try:
            training = start_training(plan, images, out, workers, bar.look)
            bar.follow(training)
        except KeyboardInterrupt:
            raise RecognizerError(f"stopped; the same command goes on from here: {out}") from None
        finally:
            bar.close()
    if workers.is_first:
        path = write_results(training, plan, out)
        print(f"the training is over: {training.end}\nwritten to {path}, not calibrated yet")
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `placerec` and return its exit code: 0 good, 1 does not conform, 2 bad input."""
    # A class that is being written is found in the current folder, as by `python -m`.
    sys.path.append(str(Path.cwd()))
    try:
        return int(app.cli(prog="placerec", args=arguments, description=DESCRIPTION))
    except RecognizerError as error:
        print(f"placerec: {error}", file=sys.stderr)
        return BAD_USAGE


class _TrainingBar:
    """What a training is doing, in one line."""

    def __init__(self, steps: int | None, interrupted: Event, *, is_shown: bool) -> None:
        self._interrupted = interrupted
        hidden = None if is_shown else True
        self._bar = tqdm(total=steps, desc="training", unit="step", leave=False, disable=hidden)
        self.close = self._bar.close

    def look(self, done: int, total: int) -> None:
        self._show(f"looking at image {done} of {total}")

    def follow(self, training: "Training") -> None:
        # Closed, it writes its checkpoint at once.
        with closing(iter(training)) as records:
            for record in records:
                self._bar.update(record.step - self._bar.n)
                self._show(
                    f"loss {record.loss:.3f}, {record.sets_left} sets left, "
                    f"{record.images_per_s:.0f} images/s, {record.time_to_go_s / 60:.1f} min to go"
                )

    def _show(self, what: str) -> None:
        self._bar.set_postfix_str(what)
        if self._interrupted.is_set():
            raise KeyboardInterrupt


def _open(source: str, part: str = "test") -> PlaceDataset:
    dataset = open_dataset(source, part)
    for broken in dataset.skipped:
        print(f"placerec: skipped: {broken.why}: {broken.path}", file=sys.stderr)
    return dataset


def _embed(
    name: str, recognizer: PlaceRecognizer, dataset: PlaceDataset
) -> tuple[NDArray[np.float32], NDArray[np.float64]]:
    title = f"{name} on {dataset.name}"
    # disable=None: no bar where nobody watches, as in a file.
    images = tqdm(dataset, desc=title, unit="image", leave=False, disable=None)
    return evaluation.embed_all(recognizer, images)


def _description(dataset: PlaceDataset) -> str:
    revisits = dataset.comparable & dataset.same_place
    found = revisits.any(axis=1)
    return (
        f"{dataset.name}: {len(dataset)} images ({len(dataset.skipped)} skipped), "
        f"{dataset.pairs.sum()} pairs count, {(dataset.pairs & revisits).sum()} of them show one "
        f"place; {found.sum()} of {found.size} queries have a match"
    )


def _summary(certificate: Certificate) -> str:
    low, high = certificate.threshold_interval
    least, most = certificate.recall_interval
    return (
        f"threshold {certificate.threshold:.4f} (95 % interval {low:.4f} to {high:.4f}), "
        f"recall at 100 % precision {certificate.recall:.3f} ({least:.3f} to {most:.3f})"
    )


def _table(report: Report) -> str:
    width = max(len(check.name) for check in report.checks)
    return "\n".join(
        f"{'ok  ' if check.passed else 'FAIL'}  {check.name:<{width}}  {check.detail}"
        for check in report.checks
    )


if __name__ == "__main__":
    sys.exit(main())
