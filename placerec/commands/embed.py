# SPDX-License-Identifier: Apache-2.0
"""`placerec embed`: what a recognizer makes of the images of many folders, as arrays in files."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from placerec.certificate import fingerprint, own_fingerprint
from placerec.commands.console import note, progress_bar, say
from placerec.commands.data import RECOGNIZER, Data, open_images, without_truth
from placerec.commands.fleet import (
    CORES,
    MEMORY_MB,
    Fleet,
    asked_for,
    from_anywhere,
    run_named,
)
from placerec.datasets import PlaceDataset
from placerec.datasets.names import find_data
from placerec.datasets.tum_lists import read_images
from placerec.errors import RecognizerError, cause_of
from placerec.evaluation.embedding_file import (
    SUFFIX,
    Embedded,
    EmbeddingFile,
    embedded_csv,
    embedded_table,
    read_embedding_file,
    write_embedding_file,
)
from placerec.evaluation.embeddings import EmbeddingCache, embed_dataset
from placerec.files import Progress, is_file, write_atomically
from placerec.recognizer import load

TABLE = "embeddings.csv"
_NOT_HERE = "its file does not show here; all nodes have to see --out at the same path"
_log = logging.getLogger("placerec")


@dataclass(frozen=True)
class Task:
    """What is embedded by one process, in plain words, as it goes to another machine.

    Attributes:
        source: data as it was typed, its folder from the root on.
        recognizer: likewise.
        file: to be written.
        use_cache: keep the embedding of each image.
    """

    source: str
    recognizer: str
    file: str
    use_cache: bool


def embed(
    data: Data,
    /,
    recognizer: Annotated[str, tyro.conf.arg(metavar=RECOGNIZER)] = "learned",
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("runs/embeddings"),
    cache: bool = True,
    address: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None,
    cores: Annotated[int, tyro.conf.arg(metavar="NUMBER")] = CORES,
    memory_mb: Annotated[int, tyro.conf.arg(metavar="MB")] = MEMORY_MB,
) -> int:
    """Embed the images of folders, and leave the embeddings in files.

    Example: placerec embed recordings/* --out runs/embeddings --address local

    DIR then holds NAME.npz for each of the data, arrays for numpy.load, and embeddings.csv, a line
    for each, which is also printed. Data that cannot be embedded stop no other; the exit code is
    then 2. The same command goes on with what is not done: the data of a file that is there, of the
    same recognizer, are not embedded again, whatever became of their images.

    Args:
        data: folders of images; of recordings with rgb.txt, which need no true poses; or in the
            formats of evaluate. The file is called as the folder.
        recognizer: installed name, package.module:ClassName, trained weights or an ONNX file.
        out: folder for the files.
        cache: keep the embedding of each image, as evaluate does.
        address: Ray cluster for many data sets at once, or local; that is this machine. Default:
            one after the other.
        cores: of each data set, with --address.
        memory_mb: likewise.
    """
    fleet = asked_for(address, cores, memory_mb)
    made_by = fingerprint(load(recognizer))
    tasks = _tasks(data, recognizer, out, cache)
    before = {name: _done(name, each, made_by) for name, each in tasks.items()}
    todo = {name: tasks[name] for name, each in before.items() if each is None}
    if len(todo) < len(tasks):
        note(f"{len(tasks) - len(todo)} of {len(tasks)} data sets are embedded already")
    try:
        whys = _embed_here(todo) if fleet is None else _embed_by(fleet, todo)
    except KeyboardInterrupt:
        raise RecognizerError(f"stopped; the same command goes on from what is in {out}") from None
    rows = [
        Embedded(name, why=whys[name])
        if name in whys
        else before[name] or _done(name, each, made_by) or Embedded(name, why=_NOT_HERE)
        for name, each in tasks.items()
    ]
    write_atomically(out / TABLE, embedded_csv(rows))
    say(f"{embedded_table(rows)}\n\nwritten to {out}")
    if failed := [row.name for row in rows if row.why]:
        raise RecognizerError(
            f"{len(failed)} of {len(rows)} data sets failed, which the same command tries again:"
            f" {', '.join(failed)}"
        )
    return 0


def _tasks(data: Sequence[str], recognizer: str, out: Path, use_cache: bool) -> dict[str, Task]:
    """Return what is to be done, by the names of the data, and make the folder.

    Raises:
        RecognizerError: there is nothing, two have one name, or the folder cannot be made.
    """
    if not data:
        raise RecognizerError("embed needs at least one folder of images; see --help")
    tasks: dict[str, Task] = {}
    for source in data:
        where = _located(source)
        name = Path(where).name
        if other := tasks.get(name):
            raise RecognizerError(
                f"two are called {name}; give each a folder of its own with --out, one at a time: "
                f"{other.source} and {where}"
            )
        file = str(out.resolve() / f"{name}{SUFFIX}")
        tasks[name] = Task(where, from_anywhere(recognizer), file, use_cache)
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RecognizerError(f"cannot make the folder: {error.strerror}: {out}") from error
    return tasks


def _located(source: str) -> str:
    """Return data with the folder named from the root on; where there is none, as they are."""
    folder, colon, part = (source, "", "") if find_data(source) else source.rpartition(":")
    found = find_data(folder) if folder else None
    return f"{found.resolve()}{colon}{part}" if found else source


def _done(name: str, task: Task, made_by: str) -> Embedded | None:
    """Return what there is to tell of a file, None where there is none yet.

    Raises:
        RecognizerError: it is of other data, of another recognizer, or something else.
    """
    file = Path(task.file)
    if not is_file(file):
        return None
    found = read_embedding_file(file)
    if (found.source, found.fingerprint) != (task.source, made_by):
        whose = "another recognizer" if found.source == task.source else f"the data {found.source}"
        raise RecognizerError(
            f"{file.name} is there, and of {whose}; choose another folder with --out, or remove"
            f" what is to be done again: {file}"
        )
    return Embedded(name, len(found.images), found.skipped, found.embeddings.shape[1:])


def _embed_here(tasks: dict[str, Task]) -> dict[str, str]:
    whys = {}
    for number, (name, task) in enumerate(tasks.items(), 1):
        with progress_bar(f"{number}/{len(tasks)} {name}") as progress:
            if why := embed_alone(task, progress):
                whys[name] = why
                _log.error("%s: %s", name, why)
    return whys


def _embed_by(fleet: Fleet, tasks: dict[str, Task]) -> dict[str, str]:
    if not tasks:
        return {}
    note(f"embedding {len(tasks)} data sets, by {fleet.where}")
    return run_named(embed_alone, tasks, fleet, "embedding", "data set")


def embed_alone(task: Task, progress: Progress | None = None) -> str:
    """Embed by itself what a task names; return why that failed, "" where it did not."""
    try:
        recognizer = load(task.recognizer)
        has_cache = task.use_cache and own_fingerprint(recognizer) is not None
        images = _opened(task.source)
        kept = EmbeddingCache(recognizer) if has_cache else None
        embedded = embed_dataset(recognizer, images, kept, progress)
        made = EmbeddingFile(
            source=task.source,
            fingerprint=fingerprint(recognizer),
            images=tuple(str(path.absolute()) for path in images.paths),
            skipped=len(images.skipped),
            embeddings=embedded.embeddings,
            timestamps_s=images.timestamps_s,
        )
        write_embedding_file(made, Path(task.file))
    except Exception as error:  # hours of work on others are not to be lost to one
        return cause_of(error)
    return ""


def _opened(source: str) -> PlaceDataset:
    listed = Path(source) / "rgb.txt"
    if not is_file(listed):
        return open_images(source, "test")
    warnings: list[str] = []
    timestamps_s, paths = read_images(listed, warnings)
    for warning in warnings:
        _log.warning("%s", warning)
    return without_truth(Path(source).name, paths, timestamps_s)
