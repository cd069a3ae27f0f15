# SPDX-License-Identifier: Apache-2.0
"""`placerec export`: a trained network as an ONNX file."""

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
import tyro

from placerec.certificate import certificate_path, write_certificate
from placerec.commands.console import say
from placerec.commands.data import RECOGNIZER
from placerec.conformance.made_images import places
from placerec.errors import RecognizerError
from placerec.files import write_atomically
from placerec.recognizer import ONNX_SUFFIX, load
from placerec.recognizers.default import DEFAULT_NAME
from placerec.recognizers.onnx_file import OnnxRecognizer

_MOST_APART = 1e-5


def export(
    recognizer: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar=RECOGNIZER)],
    /,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
) -> int:
    """Write a trained network as an ONNX file, which others can run.

    Example: placerec export runs/mine/weights.safetensors --out mine.onnx

    The file says how images are prepared for it, and keeps the threshold. It is written once it
    gives the same embeddings to 1e-5, and then is a recognizer: run_slam demo --recognizer
    mine.onnx. A certificate is put beside it where the network has one.

    Args:
        recognizer: a file that placerec train wrote, or learned.
        out: what to write, a name that ends in .onnx; default: NAME.onnx, here.
    """
    path = Path(f"{Path(recognizer).stem}{ONNX_SUFFIX}") if out is None else out
    if path.suffix != ONNX_SUFFIX or not path.parent.is_dir():
        raise RecognizerError(
            f"export needs a FILE that ends in {ONNX_SUFFIX}, in a folder that is there: {path}"
        )
    # Loaded here, because torch takes seconds that recognizers without weights do not need.
    from placerec.networks.onnx_export import to_onnx
    from placerec.recognizers.learned import LearnedRecognizer

    # By name it may be run by onnxruntime already.
    learned = LearnedRecognizer() if recognizer == DEFAULT_NAME else load(recognizer)
    if not isinstance(learned, LearnedRecognizer):
        raise RecognizerError(f"{recognizer} is no trained network, which alone can be exported")
    certificate = learned.certificate  # which may not be fit to go along: asked for first
    content: bytes = to_onnx(learned.network, learned.min_similarity).SerializeToString()
    with TemporaryDirectory() as folder:
        written = Path(folder) / path.name
        written.write_bytes(content)
        exported, images = OnnxRecognizer(written), places()
        apart = np.abs(exported.embed_many(images) - learned.embed_many(images)).max()
        fingerprint = exported.fingerprint
    if not apart <= _MOST_APART:
        raise RecognizerError(
            f"what was exported gives other embeddings, {apart:.1g} apart where {_MOST_APART:g} is "
            f"allowed; nothing was written: {path}"
        )
    write_atomically(path, content)
    said = f"embeddings are the same to {apart:.1g}\nwritten to {path}"
    if certificate:
        beside = certificate_path(path)
        own = {"recognizer": path.name, "fingerprint": fingerprint}
        write_certificate(certificate.model_copy(update=own), beside)
        said += f"\ncertificate written to {beside}"
    say(said)
    return 0
