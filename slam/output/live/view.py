# SPDX-License-Identifier: Apache-2.0
"""What a run does, shown while it goes on; whatever happens to the view, the run goes on."""

import logging
import os
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Self

from placerec.errors import cause_of
from slam.result import SlamResult
from slam.system import Slam
from slam.tracking.tracked_frame import TrackedFrame
from slam.types import Camera, Frame, Rejection, SlamError

if TYPE_CHECKING:
    from slam.output.live.outlets import Outlet
    from slam.output.live.scene import Scene

_EVERY_S = 0.25
_SUFFIX = ".rrd"
_log = logging.getLogger(__name__)


def check_live(rrd: Path | None = None) -> None:
    """Refuse what cannot be shown, before anything is done.

    Raises:
        SlamError: Rerun is not installed, or the file has not the suffix that its viewer opens, or
            is a folder.
    """
    if find_spec("rerun") is None:
        raise SlamError(
            "to show a run takes Rerun, which is not installed: pip install 'loopclose[live]'"
        )
    if rrd is not None and rrd.suffix != _SUFFIX:
        raise SlamError(f"--rrd writes a file that ends in {_SUFFIX}, as Rerun opens them: {rrd}")
    if rrd is not None and rrd.is_dir():
        raise SlamError(f"--rrd writes a file, and this is a folder: {rrd}")


class LiveView:
    """Shows a run in a Rerun viewer, keeps it in a file for one, or both; a context.

    It is told of each frame what became of it (`add`), and of the result (`finish`). A viewer that
    is closed, cannot be opened or hangs, and a full disk, are one warning, and the run goes on.
    What is shown, and under which names, is in docs/live.md.
    """

    def __init__(
        self, slam: Slam, camera: Camera, viewer: bool = True, rrd: Path | None = None
    ) -> None:
        """Begin, with a viewer in a window of its own unless told, and with a file if named.

        Raises:
            SlamError: Rerun is not installed, or the file does not end in .rrd.
        """
        check_live(rrd)
        self._slam, self._camera = slam, camera
        self._has_viewer, self._rrd = viewer, rrd
        self._outlets: dict[str, Outlet] = {}
        self._scene: Scene | None = None
        self._sent_s = 0.0

    def __enter__(self) -> Self:
        """Open the viewer, and begin the file.

        Raises:
            SlamError: the file cannot be written.
        """
        os.environ.setdefault("RUST_LOG", "off")  # what goes wrong is said here, in one line
        # Loaded here, because it takes time and memory that others do without.
        from slam.output.live.outlets import File, Viewer
        from slam.output.live.scene import Scene

        if self._rrd is not None:
            self._outlets[f"what --rrd keeps ({self._rrd})"] = File(self._rrd)
        if self._has_viewer:
            try:
                self._outlets["the live view"] = Viewer()
            except Exception as error:
                _warn("the live view", error)
        self._scene = Scene(self._slam, self._camera, self._recordings)
        self._try(self._scene.begin)
        return self

    def __exit__(self, *_: object) -> None:
        """End the file, which then has its name; the viewer stays open."""
        self._to_each(lambda outlet: outlet.close())
        self._outlets.clear()

    def start_session(self) -> None:
        """Take the next frame for the first of another recording."""
        if self._scene:
            self._scene.start_session()

    def add(self, frame: Frame, tracked: TrackedFrame | Rejection) -> None:
        """Show a frame, and what became of it."""
        if self._scene and self._outlets:
            scene = self._scene
            self._try(lambda: scene.add(frame, tracked))
            if time.monotonic() - self._sent_s > _EVERY_S:
                self._to_each(lambda outlet: outlet.flush())
                self._sent_s = time.monotonic()

    def finish(self, result: SlamResult) -> None:
        """Show what the run found out, in place of what it thought on the way."""
        if self._scene and self._outlets:
            scene = self._scene
            self._try(lambda: scene.finish(result))

    @property
    def _recordings(self) -> Callable[[], list[object]]:
        return lambda: [each.recording for each in self._outlets.values()]

    def _try(self, show: Callable[[], None]) -> None:
        try:
            show()
        except Exception as error:  # the run is worth more than its view
            _log.debug("a frame could not be shown", exc_info=True)
            for name in list(self._outlets):
                self._give_up(name, error)

    def _to_each(self, do: Callable[["Outlet"], None]) -> None:
        for name, outlet in list(self._outlets.items()):
            try:
                do(outlet)
            except Exception as error:
                self._give_up(name, error)

    def _give_up(self, name: str, error: Exception) -> None:
        outlet = self._outlets.pop(name)
        _warn(name, error)
        try:
            outlet.abandon()
        except Exception:
            _log.debug("%s could not be ended", name, exc_info=True)


def _warn(name: str, error: Exception) -> None:
    _log.warning("the run goes on without %s: %s", name, cause_of(error))
