# SPDX-License-Identifier: Apache-2.0
"""`placerec calibrate`: from which similarity is a match worth verifying, and the evidence."""

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import tyro

from placerec.certificate import (
    SURE,
    TAIL,
    Certificate,
    Kind,
    certificate_path,
    write_certificate,
)
from placerec.commands.console import progress_bar, say
from placerec.commands.data import RECOGNIZER, Data, with_skipped_named
from placerec.datasets import PlaceDataset, open_collection
from placerec.errors import RecognizerError
from placerec.evaluation import calibration
from placerec.evaluation.calibration import Scenes
from placerec.evaluation.embeddings import embed_dataset
from placerec.evaluation.precision_recall import refuse_without_truth
from placerec.recognizer import ONNX_SUFFIX, WEIGHTS_SUFFIX, PlaceRecognizer, load
from placerec.recognizers import fitted_file


def calibrate(
    data: Data,
    /,
    recognizer: Annotated[str, tyro.conf.arg(metavar=RECOGNIZER)],
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
) -> int:
    """Find from which similarity a match is worth verifying, or right.

    Example: placerec calibrate ie_tower:validation --recognizer runs/tower/weights.safetensors

    A file of weights is given the first of these as their min_similarity, and the certificate of
    both, weights.certificate.json, is put beside them, where run_slam finds it for its report. An
    ONNX file stays as it is: it takes its min_similarity from the certificate.

    Args:
        data: images not used in training or to choose; formats as in evaluate. Each is a kind of
            scene, or a folder of such: best several, for then each is tried on the others' terms.
        recognizer: an installed name, package.module:ClassName, a file of weights or an ONNX file.
        out: write the certificate to this file, as JSON, and leave weights as they are; needed
            where the recognizer is no file.
    """
    is_file = recognizer.endswith((WEIGHTS_SUFFIX, ONNX_SUFFIX))
    if not data:
        raise RecognizerError("calibrate needs at least one folder of images; see --help")
    if out is None and not is_file:
        raise RecognizerError(
            f"{recognizer} is no file of weights that a certificate could lie beside; "
            "say with --out FILE.json where to write it"
        )
    loaded, opened = load(recognizer), [_opened(source) for source in data]
    names = [kind for kind, _ in opened]
    if twice := {kind for kind in names if names.count(kind) > 1}:
        raise RecognizerError(f"{min(twice)} is named twice; each kind of scene has one say")
    kinds = [_embedded(loaded, recognizer, *kind) for kind in opened]
    name = Path(recognizer).name if is_file else recognizer
    certificate = calibration.calibrate(name, loaded, kinds)
    kept = _keep(certificate, recognizer, out)
    lines = [line for kind in certificate.kinds for line in _lines(kind)]
    low, high = certificate.min_similarity_interval
    least, most = certificate.threshold_interval
    say(
        "\n".join(lines)
        + f"\nworth verifying from {certificate.min_similarity:.4f} (95 % interval "
        f"{low:.4f} to {high:.4f}): {TAIL:.0%} of the pairs of different places are so alike, and "
        f"{certificate.recall_to_verify:.1%} of those of one place\n"
        f"taken for one place from {certificate.threshold:.4f} ({least:.4f} to {most:.4f}): "
        f"{SURE:.1%}, and {certificate.recall:.1%}\n{kept}"
    )
    return 0


def _opened(source: str) -> tuple[str, list[PlaceDataset]]:
    """Return the name of a kind of scene and its datasets."""
    datasets = [with_skipped_named(dataset) for dataset in open_collection(source)]
    for dataset in datasets:
        refuse_without_truth(dataset)
    return datasets[0].name if len(datasets) == 1 else Path(source).resolve().name, datasets


def _embedded(
    recognizer: PlaceRecognizer, title: str, name: str, datasets: Sequence[PlaceDataset]
) -> Scenes:
    embeddings = []
    for dataset in datasets:
        with progress_bar(f"{title} on {dataset.name}", len(dataset)) as progress:
            embedded = embed_dataset(recognizer, dataset, progress=progress)
        embeddings.append(embedded.embeddings)
    return Scenes(name, datasets, embeddings)


def _lines(kind: Kind) -> Iterator[str]:
    """Yield what a kind of scene is, and how it would fare without a say."""
    yield (
        f"{kind.data}: {kind.images} images ({kind.skipped} skipped), {kind.pairs} pairs count, "
        f"{kind.same_place_pairs} of them show one place"
    )
    for reached, what in (
        (kind.left_out_to_verify, "worth verifying"),
        (kind.left_out_tau, "taken for one place"),
    ):
        if reached:
            yield (
                f"  left out, {what} from {reached.threshold:.4f}: of different places "
                f"{reached.different_places:.2%} pass, of one place {1 - reached.same_place:.1%} "
                "are cut"
            )


def _keep(certificate: Certificate, weights: str, out: Path | None) -> str:
    """Write what was found to where it belongs, and return what was done."""
    if out is not None:
        write_certificate(certificate, out)
        return f"certificate written to {out}"
    if weights.endswith(ONNX_SUFFIX):
        path = certificate_path(Path(weights))
        write_certificate(certificate, path)
        return f"certificate, which min_similarity is taken from, written to {path}"
    if owner := fitted_file.owner_of(Path(weights)):
        path = fitted_file.keep_calibration(Path(weights), owner, certificate)
    else:
        # Loaded here, because torch takes seconds that recognizers without weights do not need.
        from placerec.recognizers.learned import keep_calibration

        path = keep_calibration(Path(weights), certificate)
    return f"min_similarity written to {weights}\ncertificate written to {path}"
