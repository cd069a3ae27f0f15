# SPDX-License-Identifier: Apache-2.0
"""The report page: numbers, pictures and words put into the template."""

import platform
from collections import Counter
from importlib import metadata, resources
from pathlib import Path

import jinja2
import numpy as np
from markupsafe import Markup

from placerec.files import write_atomically
from slam.evaluation.drift import DriftReport, TrajectoryError
from slam.evaluation.motion_truth import RIGHT_MEDIAN_NEES
from slam.output.decision import ACCEPTED, FALSE, Decision, decisions
from slam.output.report.doubt import by_doubt, is_doubtful
from slam.output.report.flat_drawings import drift_along_time, path_from_above
from slam.output.report.headline import figures, headline
from slam.output.report.losses import losses
from slam.output.report.page_data import curves, page_data
from slam.output.report.paths import gather
from slam.output.report.pictures import picture_of
from slam.result import SlamResult
from slam.types import RejectionReason

_MOST_ROWS = 2000
"""Decisions on the page; all of them are in the ledger."""

_MAP_QUALITY = 80
_KINDS = (FALSE, ACCEPTED, *(reason.name.lower() for reason in RejectionReason))
_PACKAGES = ("loopclose", "gtsam", "numpy", "opencv-python-headless")
_LIBRARY = "vendored/plotly-gl3d.min.js"
_SCRIPTS = ("unpacking.js", "picking.js", "map.js", "scene.js", "charts.js", "loops.js", "page.js")


def write_report(
    path: Path,
    result: SlamResult,
    drift: DriftReport | None,
    settings_toml: str,
    title: str,
) -> None:
    """Write the page that explains a run, HTML that needs no other file.

    Raises:
        LoopcloseError: the file cannot be written.
    """
    loops = decisions(result, drift)
    ordered = by_doubt(loops)
    listed, others = ordered[:_MOST_ROWS], ordered[_MOST_ROWS:]
    paths = gather(result, drift)
    data = page_data(result, drift, paths, listed, others)
    frames = len(result.trajectory) + len(result.untracked_s)
    page = (
        _environment(frames)
        .get_template("page.html")
        .render(
            title=title,
            result=result,
            drift=drift,
            headline=headline(result, drift, loops),
            figures=figures(result, drift, loops),
            errors=_errors(drift) if drift else [],
            right_nees=RIGHT_MEDIAN_NEES,
            frames=frames,
            counts=_count(loops),
            path_drawing=path_from_above(paths, loops),
            drift_drawing=drift_along_time(paths, curves(result, drift)),
            loops=[(loop, is_doubtful(loop)) for loop in listed],
            attempted=len(loops),
            influences=any(loop.attempt.influence for loop in listed),
            used_otherwise=result.calibration is not None
            and not np.isclose(
                result.min_similarity, result.calibration.certificate.min_similarity, atol=1e-6
            ),
            moved=len({each.min_similarity for each in result.attempts}) > 1,
            paths=paths,
            losses=losses(result, paths),
            map_pictures=_map_pictures(result),
            settings=settings_toml,
            versions=_versions(),
            data=data,
            style=_part("page.css"),
            library=_part(_LIBRARY),
            script=Markup("\n").join(_part(name) for name in _SCRIPTS),
        )
    )
    write_atomically(path, page)


def _map_pictures(result: SlamResult) -> list[tuple[str, str, str]]:
    """Return of each picture of the meshes its data URI, what it shows and how it looks there."""
    meshes = result.meshes
    if meshes is None:
        return []
    each = [(meshes.before, "before loop closure")] if meshes.before else []
    each.append((meshes.after, "after loop closure" if meshes.before else "as it was corrected"))
    near = f"where keyframe {meshes.closer_id} looked"
    return [
        (picture_of(picture, picture.shape[1], _MAP_QUALITY), what, when)
        for what, pictures in (
            ("The whole, from above", [mesh.overview for mesh, _ in each]),
            (f"Closer, {near}", [mesh.closer for mesh, _ in each]),
        )
        for picture, (_, when) in zip(pictures, each, strict=True)
    ]


def _environment(frames: int) -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("slam.output.report", "page"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    environment.filters.update(
        number=_number,
        percent=lambda share: f"{_number(100.0 * share, 1)} %",
        ms_per_frame=lambda seconds: 1000 * seconds / max(frames, 1),
    )
    return environment


def _part(name: str) -> Markup:
    """Return a file of the page as it is: style or script, ours and not to be escaped."""
    return Markup(resources.files("slam.output.report").joinpath("page", name).read_text("utf-8"))


def _errors(drift: DriftReport) -> list[tuple[str, TrajectoryError | None, str]]:
    """Return name, error and CSS class, which is that of its colour, of each trajectory."""
    rows: list[tuple[str, TrajectoryError | None, str]] = [
        ("Odometry, live", drift.odometry, "b"),
        ("Corrected, live", drift.live, ""),
        ("In the end, without loops", drift.without_loops, "w"),
        ("In the end, with loops", drift.corrected, "a"),
    ]
    return [*rows, ("The same, smoothed", drift.smoothed, "")] if drift.smoothed else rows


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
