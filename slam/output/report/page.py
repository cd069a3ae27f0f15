# SPDX-License-Identifier: Apache-2.0
"""The report page: drawings, pictures, tables and words put into the template."""

import platform
from collections import Counter
from importlib import metadata
from pathlib import Path

import jinja2
import numpy as np
from markupsafe import Markup

from placerec.files import write_atomically
from slam.evaluation.drift import DriftReport, TrajectoryError
from slam.evaluation.motion_truth import RIGHT_MEDIAN_NEES
from slam.output.decision import ACCEPTED, FALSE, Decision, decisions
from slam.output.report.gallery import choose, picture
from slam.output.report.headline import headline, length
from slam.output.report.path_figures import error_over_time, path_view
from slam.output.report.paths import Paths, gather
from slam.output.report.place_figures import (
    calibrated_range,
    distance_matrix,
    similarity_histogram,
    similarity_matrix,
)
from slam.result import SlamResult
from slam.types import RejectionReason, Trajectory

_MAX_ROWS = 1000
"""Decisions listed on the page; all of them are in the ledger."""

_KINDS = (ACCEPTED, FALSE, *(reason.name.lower() for reason in RejectionReason))
_PACKAGES = ("loopclose", "gtsam", "numpy", "opencv-python-headless", "matplotlib")


def write_report(
    path: Path,
    result: SlamResult,
    drift: DriftReport | None,
    settings_toml: str,
    title: str,
    truth: Trajectory | None = None,
) -> None:
    """Write the page that explains a run, HTML that needs no other file.

    `truth` adds the true path to the drawings.

    Raises:
        LoopcloseError: the file cannot be written.
    """
    loops = decisions(result, drift)
    chosen = choose(loops) if result.has_images else []
    paths = gather(result, drift, truth)
    frames = len(result.trajectory) + len(result.untracked_s)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("slam.output.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters.update(
        length=length,
        number=_number,
        percent=lambda share: f"{_number(100.0 * share, 1)} %",
        elapsed=lambda timestamp_s: float(paths.elapsed_s(np.array(timestamp_s))),
        ms_per_frame=lambda seconds: 1000 * seconds / max(frames, 1),
    )
    page = environment.get_template("page.html").render(
        title=title,
        result=result,
        drift=drift,
        headline=headline(result, drift, loops),
        errors=_errors(drift) if drift else [],
        right_nees=RIGHT_MEDIAN_NEES,
        frames=frames,
        counts=_count(loops),
        drawings=_drawings(result, drift, paths, loops),
        cards=[(loop, picture(loop, result.camera)) for loop in chosen],
        card_counts=_count(chosen),
        loops=loops[:_MAX_ROWS],
        attempted=len(loops),
        accepted=sum(loop.attempt.rejection is None for loop in loops),
        false=sum(loop.kind == FALSE for loop in loops),
        used_otherwise=result.calibration is not None
        and not np.isclose(
            result.min_similarity, result.calibration.certificate.min_similarity, atol=1e-6
        ),
        moved=len({each.min_similarity for each in result.attempts}) > 1,
        paths=paths,
        settings=settings_toml,
        versions=_versions(),
    )
    write_atomically(path, page)


def _errors(drift: DriftReport) -> list[tuple[str, TrajectoryError | None, str]]:
    """Return name, error and CSS class, which is that of its colour, of each trajectory."""
    rows: list[tuple[str, TrajectoryError | None, str]] = [
        ("Odometry, live", drift.odometry, "b"),
        ("Corrected, live", drift.live, ""),
        ("In the end, without loops", drift.without_loops, "w"),
        ("In the end, with loops", drift.corrected, "a"),
    ]
    return [*rows, ("The same, smoothed", drift.smoothed, "")] if drift.smoothed else rows


def _drawings(
    result: SlamResult, drift: DriftReport | None, paths: Paths, loops: list[Decision]
) -> dict[str, Markup]:
    first, second, third = paths.axes
    drawings = {
        "top": path_view(paths, loops, (min(first, second), max(first, second))),
        "side": path_view(paths, loops, (min(first, third), max(first, third))),
        "similarity": similarity_matrix(result, loops),
        "distance": distance_matrix(paths, loops),
        "error": error_over_time(paths, result, drift, loops),
    }
    if loops:
        drawings["histogram"] = similarity_histogram(loops, result.min_similarity)
    if result.calibration is not None:
        drawings["calibrated"] = calibrated_range(result.calibration, result.min_similarity)
    return drawings


def _count(loops: list[Decision]) -> list[tuple[str, str, int]]:
    """Return kind, its meaning and how many there are; kinds without any are left out."""
    numbers = Counter(loop.kind for loop in loops)
    labels = {loop.kind: loop.label for loop in loops}
    return [(kind, labels[kind], numbers[kind]) for kind in _KINDS if kind in numbers]


def _versions() -> list[tuple[str, str]]:
    found = [("python", platform.python_version())]
    for package in _PACKAGES:
        try:
            found.append((package, metadata.version(package)))
        except metadata.PackageNotFoundError:
            continue
    return found


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None or not np.isfinite(value) else f"{value:.{digits}f}"
