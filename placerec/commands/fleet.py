# SPDX-License-Identifier: Apache-2.0
"""Many tasks at once, on this machine or on a cluster: the only door to Ray.

Ray starts the tasks, hands them to nodes with the cores and the memory that they need, and starts
again those whose process or node died.
"""

import logging
import os
import socket
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, Generic, TypeVar
from urllib.parse import urlsplit

from placerec.commands.console import progress_bar
from placerec.errors import RecognizerError, cause_of, terminations_interrupt
from placerec.files import is_file

LOCAL = "local"
"""Ray's own word for the address of a cluster of this machine alone, which is started for it."""
CORES, MEMORY_MB = 1, 1024
"""Of a task, unless told."""

_RETRIES = 3  # of a task whose process or node died
_PATIENCE_S = 10.0  # with an address that does not answer
_OBJECTS_BYTES = 80 << 20  # for what tasks hand over, which is next to nothing
_OURS = "LOOPCLOSE_"  # variables that say where data and weights are
_CACHE = "XDG_CACHE_HOME"  # and this where embeddings are kept
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_ALWAYS = {
    "RAY_USAGE_STATS_ENABLED": "0",  # it reports to its makers unless told not to
    "RAY_task_oom_retries": str(_RETRIES),  # without memory it would try again for ever
}
# By which it listens on 127.0.0.1 alone; else on every network that the machine is in.
_HERE = {"RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0"}
_TEMPORARY = "/tmp"  # as Ray has it: names of sockets are short, and so has the folder's to be
_log = logging.getLogger("placerec")
T = TypeVar("T")
R = TypeVar("R")


class Interrupted(Exception):  # noqa: N818  # it is no error
    """Raised by a task that was asked to end before it was done; it is started again."""


@dataclass(frozen=True)
class Fleet:
    """Where tasks are done, and what each of them takes.

    Attributes:
        address: of a Ray cluster, such as ray://head:10001; `LOCAL` for this machine.
        cores: of a task, which starts no more threads to compute with.
        memory_mb: of a task, by which Ray tells how many go on a node.

    Raises:
        RecognizerError: a task would take nothing.
    """

    address: str
    cores: int
    memory_mb: int

    def __post_init__(self) -> None:
        if self.cores < 1 or self.memory_mb < 1:
            raise RecognizerError("--cores and --memory-mb have to be above 0")

    @property
    def where(self) -> str:
        """What messages call it."""
        return "the cores of this machine" if self.address == LOCAL else self.address


def asked_for(address: str | None, cores: int, memory_mb: int) -> Fleet | None:
    """Return the fleet of an address; None where there is none, and all is done in this process.

    Raises:
        RecognizerError: a task would take nothing.
    """
    fleet = Fleet(address or LOCAL, cores, memory_mb)
    return fleet if address else None


def from_anywhere(name: str) -> str:
    """Return a name with which a file is found from any folder; of what is no file, the name."""
    return str(Path(name).resolve()) if is_file(Path(name)) else name


@dataclass(frozen=True)
class Finished(Generic[R]):
    """The end of a task.

    Attributes:
        number: of the task.
        answer: what it returned; None where it did not come to that.
        why: it did not; empty where it did.
    """

    number: int
    answer: R | None
    why: str = ""


def run_all(
    work: Callable[[T], R],
    tasks: Sequence[T],
    fleet: Fleet,
    tell: Callable[[Finished[R]], None],
) -> None:
    """Do tasks, each in a process of its own, and tell of each as soon as it has ended.

    Args:
        work: what is done with a task, a function of a module that all nodes have. What it writes
            has to be the same if it is done again.
        tasks: plain values.
        fleet: where.
        tell: is told, and prints nothing on stdout.

    Raises:
        RecognizerError: Ray is not installed, the cluster cannot be reached, or no node of it has
            room for a task.
    """
    if fleet.address != LOCAL:
        _refuse_unreachable(fleet.address)
    ray = _loaded(fleet.address)
    with _connected(ray, fleet):
        _refuse_what_fits_nowhere(ray.nodes(), fleet)
        remote = ray.remote(
            num_cpus=fleet.cores,
            memory=fleet.memory_mb << 20,
            max_calls=1,  # a process has its settings, and its peak of memory, for one task
            max_retries=_RETRIES,
            retry_exceptions=[Interrupted],
        )(work)
        running = {remote.remote(task): number for number, task in enumerate(tasks)}
        while running:
            (done, *_), _ = ray.wait(list(running))
            number = running.pop(done)
            try:
                tell(Finished(number, ray.get(done)))
            except ray.exceptions.RayError as error:
                tell(Finished(number, None, _said(error)))


def run_named(
    work: Callable[[T], str], tasks: Mapping[str, T], fleet: Fleet, doing: str, unit: str
) -> dict[str, str]:
    """Do tasks that have names, show how far it is, and return why those that failed did.

    Args:
        work: as for `run_all`; returns why it failed, "" where it did not.
        tasks: by their names.
        fleet: where.
        doing: what is done, for the progress bar.
        unit: what a task is, likewise.

    Raises:
        RecognizerError: as `run_all` does.
    """
    names, whys, ends = list(tasks), dict[str, str](), count(1)
    with progress_bar(doing, len(tasks), unit) as progress:

        def tell(ended: Finished[str]) -> None:
            name = names[ended.number]
            if why := ended.why or ended.answer:
                whys[name] = why
                _log.error("%s: %s", name, why)
            progress(next(ends), what=name)

        run_all(work, list(tasks.values()), fleet, tell)
    return whys


def _refuse_unreachable(address: str) -> None:
    """Refuse where nobody listens: Ray would try for ten minutes, and say so on stderr."""
    parts = urlsplit(address if "://" in address else f"//{address}")
    try:
        if parts.hostname and parts.port:  # others, such as `auto`, Ray finds out itself
            socket.create_connection((parts.hostname, parts.port), _PATIENCE_S).close()
    except (OSError, ValueError) as error:
        raise RecognizerError(f"cannot reach the cluster at {address}: {error}") from error


def _loaded(address: str) -> Any:
    os.environ.update(_ALWAYS | _HERE if address == LOCAL else _ALWAYS)  # read when it is loaded
    try:
        import ray
    except ImportError as error:
        raise RecognizerError(
            "many runs at once need the package Ray: pip install 'loopclose[fleet]'"
        ) from error
    return ray


@contextmanager
def _connected(ray: Any, fleet: Fleet) -> Iterator[None]:
    variables = {
        name: value
        for name, value in os.environ.items()
        if name.startswith(_OURS) or name == _CACHE
    }
    threads = dict.fromkeys(_THREADS, str(fleet.cores))
    asked = {
        "address": fleet.address,
        "runtime_env": {"env_vars": variables | threads},
        "log_to_driver": False,
        "logging_level": logging.CRITICAL,
    }
    place = tempfile.TemporaryDirectory(
        prefix="loopclose-ray-", dir=_TEMPORARY, ignore_cleanup_errors=True
    )
    with place as scratch:
        if fleet.address == LOCAL:
            asked |= {
                "include_dashboard": False,
                "object_store_memory": _OBJECTS_BYTES,
                "_temp_dir": scratch,
            }
        # It prints what it has to say of nodes that died, whatever it is told.
        with Path(os.devnull).open("w") as nowhere, redirect_stdout(nowhere):
            try:
                ray.init(**asked)
            except Exception as error:  # of many kinds
                where = "Ray here" if fleet.address == LOCAL else f"the cluster at {fleet.address}"
                raise RecognizerError(f"cannot reach {where}: {cause_of(error)}") from error
            try:
                with terminations_interrupt():  # it has taken SIGTERM for itself
                    yield
            finally:
                ray.shutdown()


def _refuse_what_fits_nowhere(nodes: Sequence[Mapping[str, Any]], fleet: Fleet) -> None:
    """Refuse a task that no node has room for: Ray would wait for one for ever."""
    free = [each["Resources"] for each in nodes if each["Alive"]]
    sizes = [(int(each.get("CPU", 0)), int(each.get("memory", 0)) >> 20) for each in free]
    if not any(cores >= fleet.cores and mb >= fleet.memory_mb for cores, mb in sizes):
        largest = max(sizes, default=(0, 0))
        raise RecognizerError(
            f"a task takes {fleet.cores} core(s) and {fleet.memory_mb} MB, which no node has; the"
            f" largest has {largest[0]} and {largest[1]} MB"
        )


def _said(error: Exception) -> str:
    """Return in one line of some length what ended a task, without a trace."""
    return str(RecognizerError(cause_of(getattr(error, "cause", None) or error)))
