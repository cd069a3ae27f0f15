# SPDX-License-Identifier: Apache-2.0
"""`placerec calibrate`: from which similarity are two images taken for one place?"""

from pathlib import Path
from typing import Annotated

import tyro

from placerec import calibration
from placerec.certificate import Certificate, write_certificate
from placerec.commands.data import RECOGNIZER, describe, embed_data, open_data
from placerec.recognizer import load


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
    loaded, dataset = load(recognizer), open_data(data)
    embeddings, _ = embed_data(recognizer, loaded, dataset)
    certificate = calibration.calibrate(recognizer, loaded, dataset, embeddings)
    write_certificate(certificate, out)
    print(f"{describe(dataset)}\n{_summary(certificate)}\nwritten to {out}")
    return 0


def _summary(certificate: Certificate) -> str:
    low, high = certificate.threshold_interval
    least, most = certificate.recall_interval
    return (
        f"threshold {certificate.threshold:.4f} (95 % interval {low:.4f} to {high:.4f}), "
        f"recall at 100 % precision {certificate.recall:.3f} ({least:.3f} to {most:.3f})"
    )
