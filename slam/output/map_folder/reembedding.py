# SPDX-License-Identifier: Apache-2.0
"""The places of a saved map embedded by another recognizer, from the small images that it keeps."""

from dataclasses import replace

import numpy as np

from placerec.certificate import fingerprint
from placerec.checked_recognizer import CheckedRecognizer
from placerec.files import Progress
from placerec.recognizer import PlaceRecognizer
from slam.config import Config
from slam.geometry.keyframe_memory import full_size
from slam.loops.saved_map import SavedMap


def reembedded(
    saved: SavedMap,
    recognizer: PlaceRecognizer,
    config: Config | None = None,
    progress: Progress | None = None,
) -> SavedMap:
    """Return a map with embeddings of its keyframes' small images, enlarged; all else is the same.

    The progress is told how many keyframes are done.

    Raises:
        RecognizerError: the recognizer failed, or nothing tells it from others.
    """
    made_by = fingerprint(recognizer)
    limit_s = (config or Config()).loop.recognizer_limit_s
    checked = CheckedRecognizer(recognizer, limit_s=limit_s)
    embeddings = []
    for done, keyframe in enumerate(saved.keyframes, start=1):
        camera = keyframe.camera or saved.camera
        rgb = full_size(keyframe.preview.rgb, (camera.height, camera.width))
        embeddings.append(checked.embed(rgb))
        if progress:
            progress(done, len(saved.keyframes))
    return replace(saved, fingerprint=made_by, embeddings=np.stack(embeddings))
