# SPDX-License-Identifier: Apache-2.0
"""The `placerec` command: one function per sub-command."""

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from numpy.typing import NDArray
from tqdm import tqdm

from placerec import calibration, evaluation
from placerec.certificate import Certificate, write_certificate
from placerec.conformance import Report
from placerec.conformance import check as check_recognizer
from placerec.cost import measure_cost
from placerec.datasets import PlaceDataset, open_dataset
from placerec.evaluation_table import LEGEND, Measured, evaluation_table
from placerec.recognizer import PlaceRecognizer, RecognizerError, available, load

DOES_NOT_CONFORM, BAD_USAGE = 1, 2

DESCRIPTION = "Recognise places: check, measure and calibrate what tells them apart."

app = tyro.extras.SubcommandApp()


@app.command
def check(
    recognizer: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="NAME|MODULE:CLASS")],
    /,
) -> int:
    """Tell what a recognizer does right and wrong.

    Args:
        recognizer: an installed recognizer's name, or package.module:ClassName.
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
        tyro.conf.arg(metavar="NAME ...", help_behavior_hint="(default: all installed)"),
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
        recognizers: installed names, or package.module:ClassName.
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
    recognizer: Annotated[str, tyro.conf.arg(metavar="NAME|MODULE:CLASS")],
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")],
) -> int:
    """Find the threshold of a recognizer: the largest recall without an error on some data.

    Example: placerec calibrate ie_tower:validation --recognizer gradients --out gradients.json

    Args:
        data: images not used in training or to choose; formats as in evaluate.
        recognizer: an installed recognizer's name, or package.module:ClassName.
        out: certificate to write beside the weights, as JSON.
    """
    loaded, dataset = load(recognizer), _open(data)
    embeddings, _ = _embed(recognizer, loaded, dataset)
    certificate = calibration.calibrate(recognizer, loaded, dataset, embeddings)
    write_certificate(certificate, out)
    print(f"{_description(dataset)}\n{_summary(certificate)}\nwritten to {out}")
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


def _open(source: str) -> PlaceDataset:
    dataset = open_dataset(source)
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
