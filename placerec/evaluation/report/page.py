# SPDX-License-Identifier: Apache-2.0
"""The page of an evaluation: drawings, photographs and tables put into the template."""

import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import count

import jinja2

from placerec.datasets import PlaceDataset, describe
from placerec.evaluation.bootstrap import CONFIDENCE, RESAMPLES
from placerec.evaluation.embeddings import installed_version
from placerec.evaluation.figures import (
    distance_map,
    precision_recall,
    recognised_places,
    svg,
    truth_map,
)
from placerec.evaluation.measurement import Failed, Measured, Measurement
from placerec.evaluation.report.costs import PAPER, cost_figures, cost_rows
from placerec.evaluation.report.examples import Match, PageFigure, first_matches, page_figure
from placerec.evaluation.tables import EARLIER, notes
from placerec.files import Progress

_PACKAGES = ("loopclose", "numpy", "opencv-python-headless", "torch", "matplotlib")


@dataclass(frozen=True)
class _Section:
    """What the page shows of a dataset; rows and matches by recognizer, matches right and wrong."""

    dataset: PlaceDataset
    description: str
    rows: dict[str, Measurement]
    best: float
    curves: list[PageFigure] = field(default_factory=list)
    maps: list[PageFigure] = field(default_factory=list)
    paths: list[PageFigure] = field(default_factory=list)
    matches: dict[str, tuple[Match | None, Match | None]] = field(default_factory=dict)


def render(rows: Sequence[Measurement], progress: Progress | None = None) -> str:
    """Return the page as HTML that needs no other file."""
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("placerec.evaluation.report", "."),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.tests["failed"] = lambda row: isinstance(row, Failed)
    measured = [row for row in rows if isinstance(row, Measured)]
    datasets = list({id(row.dataset): row.dataset for row in rows}.values())
    costs = cost_rows(measured)
    installed = {package: installed_version(package) for package in _PACKAGES}
    drawn = count(1)

    def tell() -> None:
        if progress:
            progress(next(drawn), len(measured))

    return environment.get_template("page.html").render(
        recognizers=list(dict.fromkeys(row.recognizer for row in rows)),
        sections=[
            _section(dataset, {row.recognizer: row for row in rows if row.dataset is dataset}, tell)
            for dataset in datasets
        ],
        costs=costs,
        cost_figures=cost_figures(costs) if costs else [],
        paper=PAPER,
        notes=notes(rows),
        earlier=EARLIER,
        resamples=RESAMPLES,
        confidence=CONFIDENCE,
        versions=[
            f"python {platform.python_version()}",
            *(f"{package} {version}" for package, version in installed.items() if version),
        ],
    )


def _section(
    dataset: PlaceDataset, rows: dict[str, Measurement], tell: Callable[[], None]
) -> _Section:
    measured = {name: row for name, row in rows.items() if isinstance(row, Measured)}
    pairs = {name: row.evaluation.pair_curve for name, row in measured.items()}
    best = {name: row.evaluation.best_match_curve for name, row in measured.items()}
    most = max((curve.area for curve in pairs.values()), default=0.0)
    section = _Section(dataset, describe(dataset), rows, most)
    if not measured:
        return section
    for title, curves in (("all pairs", pairs), ("best match of each query", best)):
        alt = f"Precision over recall, {title}: {dataset.name}"
        section.curves.append(page_figure(svg(precision_recall(curves, title)), alt))
    section.maps.append(
        page_figure(svg(truth_map(dataset)), f"Which images of {dataset.name} match")
    )
    for name, row in measured.items():
        found, on = row.evaluation, f"{name} on {dataset.name}"
        distances = distance_map(name, found.similarities, dataset)
        section.maps.append(page_figure(svg(distances), f"Distances: {on}"))
        if dataset.positions_m is not None:
            threshold = found.best_match_curve.balanced_threshold
            places = recognised_places(dataset, found.best_matches, threshold, name)
            section.paths.append(page_figure(svg(places), f"Recognised places on the way: {on}"))
        section.matches[name] = first_matches(dataset, found.best_matches)
        tell()
    return section
