# SPDX-License-Identifier: Apache-2.0
"""`placerec evaluate`: how well do recognizers tell places apart, and what do they cost?"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated

import tyro

from placerec.commands.console import progress_bar, say
from placerec.commands.data import RECOGNIZER, Data, open_data
from placerec.datasets import describe
from placerec.errors import RecognizerError
from placerec.evaluation.measurement import Failed, Measurement, measure
from placerec.evaluation.precision_recall import refuse_without_truth
from placerec.evaluation.tables import LEGEND, evaluation_csv, evaluation_table, notes
from placerec.files import write_atomically
from placerec.recognizer import PlaceRecognizer, available, load

_ALL = "all"
_SOMETHING_FAILED = 1


def evaluate(
    data: Data,
    /,
    recognizers: Annotated[
        tuple[str, ...],
        tyro.conf.arg(metavar=f"{RECOGNIZER}|all ...", help_behavior_hint="(default: all)"),
    ] = (_ALL,),
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("runs/evaluation"),
    cache: bool = True,
    second_look: bool = False,
) -> int:
    """Measure how well recognizers tell places apart, and what they cost.

    Example: placerec evaluate rgbd_dataset_freiburg1_desk corridor --recognizers gradients

    Two sessions: placerec evaluate walk_in_may+walk_in_june:3 --out runs/seasons

    Prints a Markdown table; DIR then holds index.html, a page with curves, matrices and pictures
    that needs no network, and results.csv, every figure in full. One recognizer that fails does
    not stop the others; the exit code is then 1. Of all that are installed, those whose weights are
    not on this machine are left out, and the page says so.

    Args:
        data: folders of images, their names under $LOOPCLOSE_DATA, or names of TUM RGB-D sequences
            as run_slam takes them. Each in one of these formats:
            - rgb.txt, groundtruth.txt: TUM RGB-D
            - Images/, *GroundTruth.mat: New College, City Centre
            - query/, ref/: two drives of one path
            - dataset.csv: clips; the test floors, or FOLDER:validation, FOLDER:train
            two of them, the one looked for in the other:
            - QUERY+REFERENCE: TUM RGB-D, with true poses in one world
            - QUERY+REFERENCE:3: any images; numbers up to 3 apart match
        recognizers: installed names, package.module:ClassName, trained weights, ONNX files; or all,
            which is all the installed.
        out: folder for the page and the CSV file.
        cache: keep embeddings of recognizers with a fingerprint, by what is in the image, and
            take them from there the next time. The folder, ~/.cache/loopclose/embeddings (or under
            $XDG_CACHE_HOME), may be deleted at any time.
        second_look: measure each recognizer once more with a second look at the ten images most
            similar to each, by its own rerank, or by local features where it has none.
    """
    if not data:
        raise RecognizerError("evaluate needs at least one folder of images; see --help")
    try:
        # All that may be wrong with what was asked is found before the long work.
        loaded = _load_all(recognizers or (_ALL,))
        rows = _measure_all(data, loaded, out, cache, second_look)
        say(f"\n{evaluation_table(rows)}\n\n{LEGEND}")
        for note in notes(rows):
            say(note)
        write_atomically(out / "results.csv", evaluation_csv(rows).encode())
        # Loaded here, because drawing takes a second to load that the other commands do not need.
        from placerec.evaluation.report.page import render

        with progress_bar("drawing", len(rows), "figure") as progress:
            page = render(rows, progress)
        write_atomically(out / "index.html", page.encode())
        say(f"written to {out / 'index.html'} and results.csv")
    except KeyboardInterrupt:
        raise RecognizerError("stopped; embeddings that were kept are not made again") from None
    left_out = {name for name, each in loaded.items() if isinstance(each, RecognizerError)}
    failed = {row.recognizer for row in rows if isinstance(row, Failed)}
    return _SOMETHING_FAILED if failed - left_out else 0


def _measure_all(
    sources: Sequence[str],
    loaded: Mapping[str, PlaceRecognizer | RecognizerError],
    out: Path,
    use_cache: bool,
    second_look: bool,
) -> list[Measurement]:
    datasets = [open_data(source) for source in sources]
    for dataset in datasets:
        refuse_without_truth(dataset)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecognizerError(f"cannot make the folder: {error.strerror}: {out}") from error
    rows: list[Measurement] = []
    for dataset in datasets:
        for name, recognizer in loaded.items():
            if isinstance(recognizer, RecognizerError):
                rows.append(Failed(dataset, name, str(recognizer)))
                continue
            for again in (False, True) if second_look else (False,):
                title = f"{name}, second look" if again else name
                turn = f"{len(rows) + 1}/{len(datasets) * len(loaded) * (1 + second_look)}"
                with progress_bar(f"{turn} {title} on {dataset.name}", len(dataset)) as progress:
                    found = measure(
                        title,
                        recognizer,
                        dataset,
                        use_cache=use_cache,
                        second_look=again,
                        progress=progress,
                    )
                rows.append(found)
        say(describe(dataset))
    return rows


def _load_all(names: Sequence[str]) -> dict[str, PlaceRecognizer | RecognizerError]:
    """Return what was named, each once; of all that are installed, some may not be loadable."""
    loaded: dict[str, PlaceRecognizer | RecognizerError] = {}
    for name in names:
        for each in available() if name == _ALL else (name,):
            try:
                loaded[each] = load(each)
            except RecognizerError as error:
                if name != _ALL:
                    raise
                loaded[each] = error
    return loaded
