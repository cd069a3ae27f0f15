# SPDX-License-Identifier: Apache-2.0
import fcntl
import gc
import os
import signal
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from placerec.certificate import Certificate, Kind
from slam.types import Camera

os.environ.pop("TQDM_DISABLE", None)  # tqdm reads it once, when it is imported

FRAMES = 60
FRAMES_PER_S = 7.5


def pytest_collection_finish() -> None:
    """Let the garbage collector look at what tests make, and no more at all of the tests."""
    gc.collect()
    gc.freeze()


@pytest.fixture(autouse=True, scope="session")
def no_weights_but_the_shipped_ones():
    """Hide the published weights of who runs the tests: what passes with them has to elsewhere."""
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("LOOPCLOSE_WEIGHTS", raising=False)
        yield


@pytest.fixture(autouse=True, scope="session")
def signals_end_processes():
    """Let signals do what they do by default where the tests were started to ignore some of them.

    Jobs in the background ignore Ctrl-C, and those of nohup SIGHUP.
    """
    usual = {
        signal.SIGINT: signal.default_int_handler,
        signal.SIGTERM: signal.SIG_DFL,
        signal.SIGHUP: signal.SIG_DFL,
    }
    before = {each: signal.signal(each, handler) for each, handler in usual.items()}
    yield
    for each, handler in before.items():
        signal.signal(each, handler)


@pytest.fixture(scope="session")
def built_rooms() -> Iterator[Callable[[int], Any]]:
    """Build each room once, which takes longer than to render a few images of it."""
    from slam.demo import recording  # which loads Open3D

    build_once = cache(recording.build_room)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "build_room", build_once)
        yield build_once


@pytest.fixture(scope="session")
def recording(tmp_path_factory: pytest.TempPathFactory, request: pytest.FixtureRequest) -> Path:
    """Return a TUM folder of 60 frames, 8 s: a third of the room there, and back again.

    There it shows every other rendered image, back the rest: no image is seen twice. It is rendered
    by the first process of tests that needs it, anew unless LOOPCLOSE_RENDERED names a folder for
    it, in which it is then found the next time.
    """
    place = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:  # one of several processes, whose folders lie together
        place = place.parent
    place = Path(os.environ.get("LOOPCLOSE_RENDERED", place))
    place.mkdir(parents=True, exist_ok=True)
    folder = place / "recording"
    with (place / "recording.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            request.getfixturevalue("built_rooms")
            _render_there_and_back(folder)
    return folder


def _render_there_and_back(folder: Path) -> None:
    from slam.demo import render_sequence

    camera = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
    render_sequence(folder, seconds=FRAMES / 15.0, camera=camera)
    order = [*range(0, FRAMES, 2), *range(FRAMES - 1, 0, -2)]
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        _, *lines = (folder / name).read_text().splitlines()
        values = [lines[i].split(" ", 1)[1] for i in order]
        stamped = [f"{100 + i / FRAMES_PER_S:.6f} {value}\n" for i, value in enumerate(values)]
        (folder / name).write_text("".join(stamped))


@pytest.fixture
def certificate():
    """Return a made-up certificate, of a recognizer and data that do not exist."""
    kind = Kind(
        data="somewhere",
        images=10,
        skipped=1,
        pairs=45,
        same_place_pairs=9,
        resampled="places",
        different_places=(-0.1, 0.6),
        same_place=(0.3, 0.9),
        threshold=0.8,
    )
    return Certificate(
        version=2,
        recognizer="gradients",
        fingerprint="sha256:0",
        kinds=(kind,),
        recall_to_verify=0.75,
        recall=0.5,
        min_similarity_interval=(0.55, 0.65),
        threshold_interval=(0.7, 0.85),
        recall_interval=(0.25, 0.75),
        resamples=100,
        seed=0,
        curve=((0.9, 0.0, 0.1), (0.8, 0.001, 0.5), (0.2, 0.5, 1.0)),
    )


@pytest.fixture(scope="session")
def needs_lancedb():
    """Skip where it is not installed: not everybody has it."""
    pytest.importorskip("lancedb", reason="needs LanceDB: pip install 'loopclose[fleet]'")
