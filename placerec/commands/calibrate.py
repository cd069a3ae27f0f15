# SPDX-License-Identifier: Apache-2.0
"""`placerec calibrate`: from which similarity is a match worth verifying, and the evidence."""

from pathlib import Path
from typing import Annotated

import tyro

from placerec.certificate import TAIL, Certificate, certificate_path, write_certificate
from placerec.commands.console import progress_bar, say
from placerec.commands.data import RECOGNIZER, open_data
from placerec.datasets import describe
from placerec.errors import RecognizerError
from placerec.evaluation import calibration
from placerec.evaluation.embeddings import embed_dataset
from placerec.recognizer import ONNX_SUFFIX, WEIGHTS_SUFFIX, load
from placerec.recognizers import fitted_file


def calibrate(
    data: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="DATA")],
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
        data: images not used in training or to choose; formats as in evaluate.
        recognizer: an installed name, package.module:ClassName, a file of weights or an ONNX file.
        out: write the certificate to this file, as JSON, and leave weights as they are; needed
            where the recognizer is no file.
    """
    is_file = recognizer.endswith((WEIGHTS_SUFFIX, ONNX_SUFFIX))
    if out is None and not is_file:
        raise RecognizerError(
            f"{recognizer} is no file of weights that a certificate could lie beside; "
            "say with --out FILE.json where to write it"
        )
    loaded, dataset = load(recognizer), open_data(data)
    with progress_bar(f"{recognizer} on {dataset.name}", len(dataset)) as progress:
        embedded = embed_dataset(loaded, dataset, progress=progress)
    name = Path(recognizer).name if is_file else recognizer
    certificate = calibration.calibrate(name, loaded, dataset, embedded.embeddings)
    kept = _keep(certificate, recognizer, out)
    low, high = certificate.threshold_interval
    least, most = certificate.recall_interval
    say(
        f"{describe(dataset)}\n"
        f"worth verifying from {certificate.min_similarity:.4f}: {TAIL:.0%} of the pairs of "
        f"different places are so alike, and {certificate.recall_to_verify:.1%} of those of one "
        f"place\nthreshold without an error {certificate.threshold:.4f} (95 % interval {low:.4f} "
        f"to {high:.4f}), recall {certificate.recall:.3f} ({least:.3f} to {most:.3f})\n{kept}"
    )
    return 0


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
