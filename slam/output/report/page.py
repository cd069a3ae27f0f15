# SPDX-License-Identifier: Apache-2.0
"""The report page: drawings, pictures, tables and words put into the template."""

import platform
from collections import Counter
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import jinja2
import numpy as np
from markupsafe import Markup

from placerec.files import write_atomically
from slam.evaluation.drift import DriftReport
from slam.output.report.decision import ACCEPTED, FALSE, Decision, decisions
from slam.output.report.gallery import choose, picture
from slam.output.report.headline import headline, length
from slam.output.report.path_figures import correction_over_time, error_over_time, path_view
from slam.output.report.paths import Paths, gather
from slam.output.report.place_figures import (
    calibrated_range,
    distance_matrix,
    similarity_histogram,
    similarity_matrix,
)
from slam.result import SlamResult
from slam.types import RejectionReason, Trajectory

MAX_ROWS = 1000
"""Decisions listed on the page; all of them are in the ledger."""

_KINDS = (ACCEPTED, FALSE, *(reason.name.lower() for reason in RejectionReason))
_PACKAGES = ("loopclose", "gtsam", "numpy", "opencv-python-headless", "open3d", "matplotlib")


@dataclass(frozen=True)
class Card:
    """A decision with its picture."""

    loop: Decision
    image: str


@dataclass(frozen=True)
class Stage:
    """How long one stage of the pipeline took; `share` is of the whole run, 0 to 1."""

    name: str
    total_s: float
    per_frame_ms: float
    share: float


def write_report(
    path: Path,
    result: SlamResult,
    drift: DriftReport | None,
    settings_toml: str,
    title: str,
    truth: Trajectory | None = None,
) -> None:
    """Write the page that explains a run; `truth` adds the true path to the drawings.

    Raises:
        LoopcloseError: the file cannot be written.
    """
    write_atomically(path, render(result, drift, settings_toml, title, truth))


def render(
    result: SlamResult,
    drift: DriftReport | None,
    settings_toml: str,
    title: str,
    truth: Trajectory | None = None,
) -> str:
    """Return the page as HTML that needs no other file."""
    loops = decisions(result, drift)
    frames = len(result.trajectory) + len(result.untracked_s)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("slam.output.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters["length"] = length
    environment.filters["number"] = number
    environment.filters["percent"] = percent
    chosen = choose(loops)
    paths = gather(result, drift, truth)
    environment.filters["elapsed"] = lambda time_s: float(paths.elapsed_s(np.array(time_s)))
    return environment.get_template("page.html").render(
        title=title,
        result=result,
        drift=drift,
        headline=headline(result, drift, loops),
        frames=frames,
        counts=count(loops),
        drawings=draw(result, drift, paths, loops),
        cards=[Card(loop, picture(loop, result.camera)) for loop in chosen],
        card_counts=count(chosen),
        loops=loops[:MAX_ROWS],
        attempted=len(loops),
        accepted=sum(loop.rejection is None for loop in loops),
        false=sum(loop.kind == FALSE for loop in loops),
        used_otherwise=is_other_threshold(result),
        paths=paths,
        stages=[stage(*each, result.elapsed_s, frames) for each in result.stage_seconds.items()],
        whole=stage("the whole run", result.elapsed_s, result.elapsed_s, frames),
        settings=settings_toml,
        versions=versions(),
    )


def draw(
    result: SlamResult, drift: DriftReport | None, paths: Paths, loops: list[Decision]
) -> dict[str, Markup]:
    """Return the drawings by name."""
    first, second, third = paths.axes
    drawings = {
        "top": path_view(paths, loops, (min(first, second), max(first, second))),
        "side": path_view(paths, loops, (min(first, third), max(first, third))),
        "similarity": similarity_matrix(result, loops),
        "distance": distance_matrix(paths, loops),
    }
    if drift is not None:
        drawings["error"] = error_over_time(paths, drift, loops)
    else:
        drawings["error"] = correction_over_time(paths, result, loops)
    if loops:
        drawings["histogram"] = similarity_histogram(loops, result.min_similarity)
    if result.calibration is not None:
        drawings["calibrated"] = calibrated_range(result.calibration, result.min_similarity)
    return drawings


def is_other_threshold(result: SlamResult) -> bool:
    """Return whether a run verified from another similarity than its recognizer's certificate."""
    if result.calibration is None:
        return False
    calibrated = result.calibration.certificate.min_similarity
    return not np.isclose(result.min_similarity, calibrated, atol=1e-6)


def count(loops: list[Decision]) -> list[tuple[str, str, int]]:
    """Return kind, its meaning and how many there are; kinds without any are left out."""
    numbers = Counter(loop.kind for loop in loops)
    labels = {loop.kind: loop.label for loop in loops}
    return [(kind, labels[kind], numbers[kind]) for kind in _KINDS if kind in numbers]


def stage(name: str, seconds: float, elapsed_s: float, frames: int) -> Stage:
    """Return the time that a stage took, and its share of that of the run."""
    share = seconds / elapsed_s if elapsed_s > 0.0 else 0.0
    return Stage(name, seconds, 1000 * seconds / max(frames, 1), share)


def versions() -> list[tuple[str, str]]:
    """Return what made the page: names and versions, those installed."""
    found = [("python", platform.python_version())]
    for package in _PACKAGES:
        try:
            found.append((package, metadata.version(package)))
        except metadata.PackageNotFoundError:
            continue
    return found


def number(value: float | None, digits: int) -> str:
    """Return a number with so many decimals, a dash where it is unknown."""
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"


def percent(share: float) -> str:
    """Return a share of one in per cent, a dash where it is unknown."""
    return f"{number(100.0 * share, 1)} %"
