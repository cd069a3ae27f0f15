# SPDX-License-Identifier: Apache-2.0
"""`placerec adapt`: tune a network to the places of one's own recordings, without labels."""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import tyro

from placerec.checked_recognizer import Embeddings
from placerec.commands.console import progress_bar, say
from placerec.commands.data import Data, with_skipped_named
from placerec.datasets import PlaceDataset
from placerec.datasets.names import did_you_mean, find_data
from placerec.errors import RecognizerError
from placerec.evaluation.bootstrap import bootstrap
from placerec.evaluation.embeddings import embed_dataset
from placerec.evaluation.precision_recall import Evaluation, evaluate
from placerec.files import is_file, write_atomically
from placerec.recognizer import PlaceRecognizer


def adapt(
    data: Data,
    /,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")],
    weights: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
) -> int:
    """Tune a network to your own recordings, without labels.

    Example: placerec adapt path/to/recording --out runs/mine

    run_slam finds where the camera was; its poses and depth tell which images show one place. From
    the first 70 % of each recording the last layer learns what changes there between two views of
    one place. The rest judges before and after: where that is no better, the weights stay as they
    were.

    DIR then holds weights.safetensors, whose path names the recognizer from then on, with the
    threshold that it started with; and the run of each recording, which is not made again.

    Args:
        data: recordings in the format of TUM RGB-D, with depth: folders, or names such as fr1_xyz.
        out: folder for the results.
        weights: what to start from, a file that train or adapt wrote; default: the package's.
    """
    # Loaded here, because torch takes seconds that the other commands do not need.
    from placerec.networks.weights_file import save_weights
    from placerec.recognizers.learned import DEFAULT_WEIGHTS, LearnedRecognizer
    from placerec.training.adaptation import adapt_last_layer, spread_of
    from placerec.training.own_recording import open_own_recording, run_slam
    from placerec.training.run import WEIGHTS_NAME

    folders = _folders(data)
    start = weights or DEFAULT_WEIGHTS
    recognizer = LearnedRecognizer(start)
    opened = []
    for folder in folders:
        run_slam(folder, out / folder.name)
        opened.append(open_own_recording(folder, out / folder.name))
    judged = [with_skipped_named(each.judged) for each in opened]
    before = _embed(recognizer, judged)
    seen = list(zip(opened, before, strict=True))
    within = [spread_of(embeddings, each.same) for each, embeddings in seen]
    beyond = [spread_of(embeddings, each.beyond) for each, embeddings in seen]
    adapt_last_layer(recognizer.network, within, beyond)
    after = _embed(recognizer, judged)
    pairs = [
        (evaluate(dataset, old), evaluate(dataset, new))
        for dataset, old, new in zip(judged, before, after, strict=True)
    ]
    table, path = _table(judged, pairs), out / WEIGHTS_NAME
    if _is_better(pairs):
        save_weights(recognizer.network, path, recognizer.min_similarity)
        say(f"{table}\nbetter: written to {path}")
    else:
        write_atomically(path, start.read_bytes())
        say(f"{table}\nno better: the weights as they were are written to {path}")
    return 0


def _folders(data: Sequence[str]) -> list[Path]:
    """Return where recordings are, each with a name of its own."""
    if not data:
        raise RecognizerError("adapt needs at least one recording; see --help")
    folders = []
    for source in data:
        folder = find_data(source)
        if folder is None or not is_file(folder / "rgb.txt"):
            hint = did_you_mean(source) or "give a folder with rgb.txt and depth.txt"
            raise RecognizerError(f"no recording in the format of TUM RGB-D: {source}; {hint}")
        folders.append(folder.resolve())
    names = [folder.name for folder in folders]
    if twice := {name for name in names if names.count(name) > 1}:
        raise RecognizerError(f"two recordings are named {min(twice)}; rename one")
    return folders


def _embed(recognizer: PlaceRecognizer, datasets: Sequence[PlaceDataset]) -> list[Embeddings]:
    embeddings = []
    for dataset in datasets:
        with progress_bar(f"looking at {dataset.name}", len(dataset)) as progress:
            embeddings.append(embed_dataset(recognizer, dataset, progress=progress).embeddings)
    return embeddings


def _is_better(pairs: Sequence[tuple[Evaluation, Evaluation]]) -> bool:
    """Return whether places are told apart better on the whole, and on no recording worse."""
    gains = [new.pair_curve.area - old.pair_curve.area for old, new in pairs]
    return min(gains) >= 0.0 and max(gains) > 0.0


def _table(datasets: Sequence[PlaceDataset], pairs: Sequence[tuple[Evaluation, Evaluation]]) -> str:
    rows = [
        "| by poses of run_slam | | average precision (95 %) | recall@1 | recall at 100 % P |",
        "|---|---|---|---:|---:|",
    ]
    for dataset, both in zip(datasets, pairs, strict=True):
        for when, found in zip(("before", "after"), both, strict=True):
            low, high = bootstrap(found, dataset).average_precision
            rows.append(
                f"| {dataset.name} | {when} | {found.pair_curve.area:.3f} ({low:.3f} to {high:.3f})"
                f" | {found.recall_at_1:.3f} | "
                f"{found.best_match_curve.recall_at_full_precision:.3f} |"
            )
    return "\n".join(rows)
