# SPDX-License-Identifier: Apache-2.0
"""`placerec evaluate`: how well do recognizers tell places apart, and what do they cost?"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Annotated

import tyro

from placerec.commands.console import note, progress_bar, say
from placerec.commands.data import RECOGNIZER, Data, open_data
from placerec.commands.fleet import (
    CORES,
    MEMORY_MB,
    Finished,
    Fleet,
    asked_for,
    from_anywhere,
    run_all,
)
from placerec.datasets import PlaceDataset, describe
from placerec.errors import RecognizerError
from placerec.evaluation.measurement import Failed, Measurement, measure
from placerec.evaluation.precision_recall import refuse_without_truth
from placerec.evaluation.tables import LEGEND, evaluation_csv, evaluation_table, notes
from placerec.files import write_atomically
from placerec.recognizer import PlaceRecognizer, available, load

_ALL = "all"
_SOMETHING_FAILED = 1
Loaded = Mapping[str, PlaceRecognizer | RecognizerError]


@dataclass(frozen=True)
class Task:
    """What is measured by one process: recognizers on a dataset.

    Attributes:
        dataset: any.
        recognizers: what each is loaded by, by the name that it was given.
        use_cache: keep embeddings.
        second_look: measure each once more, with one.
    """

    dataset: PlaceDataset
    recognizers: dict[str, str]
    use_cache: bool
    second_look: bool

    @property
    def looks(self) -> tuple[bool, ...]:
        """Whether each measurement of a recognizer is one with a second look."""
        return (False, True) if self.second_look else (False,)


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
    address: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None,
    cores: Annotated[int, tyro.conf.arg(metavar="NUMBER")] = CORES,
    memory_mb: Annotated[int, tyro.conf.arg(metavar="MB")] = MEMORY_MB,
) -> int:
    """Measure how well recognizers tell places apart, and what they cost.

    Example: placerec evaluate rgbd_dataset_freiburg1_desk corridor --recognizers gradients

    Two sessions: placerec evaluate walk_in_may+walk_in_june:3 --out runs/seasons

    Prints a table; DIR then holds index.html, a page that needs no network, and results.csv, every
    figure in full. A recognizer that fails does not stop the others; the exit code is then 1. Of
    all installed, those whose weights are not on this machine are left out, and the page says so.

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
        second_look: measure each recognizer once more, with a second look at the ten images most
            similar to each; by its own rerank, or by local features where it has none.
        address: Ray cluster for many data sets at once, or local; that is this machine. Default:
            one after the other, so that times are those of a machine that does nothing else.
        cores: of each data set, with --address.
        memory_mb: likewise.
    """
    if not data:
        raise RecognizerError("evaluate needs at least one folder of images; see --help")
    fleet = asked_for(address, cores, memory_mb)
    try:
        # All that may be wrong with what was asked is found before the long work.
        loaded = _load_all(recognizers or (_ALL,))
        names = {name: from_anywhere(name) for name in loaded}
        tasks = [Task(dataset, names, cache, second_look) for dataset in _open_all(data, out)]
        rows = _measure_here(tasks, loaded) if fleet is None else _measure_by(fleet, tasks)
        say(f"\n{evaluation_table(rows)}\n\n{LEGEND}")
        for line in notes(rows):
            say(line)
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


def _open_all(sources: Sequence[str], out: Path) -> list[PlaceDataset]:
    datasets = [open_data(source) for source in sources]
    for dataset in datasets:
        refuse_without_truth(dataset)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecognizerError(f"cannot make the folder: {error.strerror}: {out}") from error
    return datasets


def _measure_here(tasks: Sequence[Task], loaded: Loaded) -> list[Measurement]:
    rows: list[Measurement] = []
    total = len(tasks) * len(loaded) * len(tasks[0].looks)
    for task in tasks:
        turns = (f"{number}/{total} " for number in count(len(rows) + 1))
        rows += _measured(task, loaded, turns)
        say(describe(task.dataset))
    return rows


def _measure_by(fleet: Fleet, tasks: Sequence[Task]) -> list[Measurement]:
    note(f"measuring on {len(tasks)} data sets, by {fleet.where}")
    rows: list[list[Measurement]] = [[] for _ in tasks]
    ends = count(1)
    with progress_bar("measuring", len(tasks), "data set") as progress:

        def tell(ended: Finished[list[Measurement]]) -> None:
            dataset, names = tasks[ended.number].dataset, tasks[ended.number].recognizers
            measured = ended.answer or [Failed(dataset, name, ended.why) for name in names]
            rows[ended.number] = [replace(row, dataset=dataset) for row in measured]
            progress(next(ends), what=dataset.name)

        run_all(measure_alone, [_from_anywhere(task) for task in tasks], fleet, tell)
    for task in tasks:
        say(describe(task.dataset))
    return [row for some in rows for row in some]


def _from_anywhere(task: Task) -> Task:
    paths = tuple(path.absolute() for path in task.dataset.paths)
    return replace(task, dataset=replace(task.dataset, paths=paths))


def measure_alone(task: Task) -> list[Measurement]:
    """Measure in a process of its own, that of a fleet."""
    loaded = {name: _load_or_say_why(where) for name, where in task.recognizers.items()}
    return _measured(task, loaded, count(1))


def _measured(task: Task, loaded: Loaded, turns: Iterator[object]) -> list[Measurement]:
    rows: list[Measurement] = []
    for name, recognizer in loaded.items():
        if isinstance(recognizer, RecognizerError):
            rows.append(Failed(task.dataset, name, str(recognizer)))
            continue
        for again in task.looks:
            title = f"{name}, second look" if again else name
            bar = f"{next(turns)}{title} on {task.dataset.name}"
            with progress_bar(bar, len(task.dataset)) as progress:
                found = measure(
                    title,
                    recognizer,
                    task.dataset,
                    use_cache=task.use_cache,
                    second_look=again,
                    progress=progress,
                )
            rows.append(found)
    return rows


def _load_all(names: Sequence[str]) -> dict[str, PlaceRecognizer | RecognizerError]:
    """Return what was named, each once; of all that are installed, some may not be loadable."""
    loaded: dict[str, PlaceRecognizer | RecognizerError] = {}
    for name in names:
        if name == _ALL:
            loaded |= {each: _load_or_say_why(each) for each in available()}
        else:
            loaded[name] = load(name)
    return loaded


def _load_or_say_why(name: str) -> PlaceRecognizer | RecognizerError:
    try:
        return load(name)
    except RecognizerError as error:
        return error
