# SPDX-License-Identifier: Apache-2.0
"""The page of an evaluation: drawings, photographs and tables put into the template."""

import platform
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib import metadata

import jinja2

from placerec.datasets import PlaceDataset, describe
from placerec.evaluation.bootstrap import CONFIDENCE, RESAMPLES
from placerec.evaluation.figures import (
    distance_map,
    precision_recall,
    recognised_places,
    svg,
    truth_map,
)
from placerec.evaluation.measurement import Failed, Measured, Measurement
from placerec.evaluation.report.costs import PAPER, cost_drawings, cost_rows
from placerec.evaluation.report.examples import Drawing, Match, drawing, first_matches
from placerec.evaluation.tables import EARLIER, notes
from placerec.files import Progress

PACKAGES = ("loopclose", "numpy", "opencv-python-headless", "torch", "matplotlib")


@dataclass(frozen=True)
class Section:
    """What the page shows of a dataset.

    Attributes:
        dataset: which.
        description: its images and pairs, in a line.
        rows: what was measured on it, or why it was not.
        curves: precision and recall over all pairs and over the best matches.
        maps: the truth and each method's distances.
        paths: each method's recognised places on the way, where that is known.
        matches: each method's first right and first wrong match.
    """

    dataset: PlaceDataset
    description: str
    rows: list[Measurement]
    curves: list[Drawing]
    maps: list[Drawing]
    paths: list[Drawing]
    matches: dict[str, tuple[Match | None, Match | None]]


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
    drawn = _counted(len(measured), progress)
    costs = cost_rows(measured)
    return environment.get_template("page.html").render(
        recognizers=list(dict.fromkeys(row.recognizer for row in rows)),
        sections=[
            _section(dataset, [row for row in rows if row.dataset is dataset], drawn)
            for dataset in datasets
        ],
        overview={(row.recognizer, id(row.dataset)): row for row in rows},
        identity=id,
        best=_best(measured),
        costs=costs,
        cost_drawings=cost_drawings(costs) if costs else [],
        paper=PAPER,
        notes=notes(rows),
        earlier=EARLIER,
        resamples=RESAMPLES,
        confidence=CONFIDENCE,
        versions=_versions(),
    )


def _section(dataset: PlaceDataset, rows: list[Measurement], drawn: Callable[[], None]) -> Section:
    measured = {row.recognizer: row for row in rows if isinstance(row, Measured)}
    section = Section(dataset, describe(dataset), rows, [], [], [], {})
    if not measured:
        return section
    section.curves.extend(_curves(dataset, measured))
    section.maps.append(drawing(svg(truth_map(dataset)), f"Which images of {dataset.name} match"))
    for name, row in measured.items():
        found, on = row.evaluation, f"{name} on {dataset.name}"
        section.maps.append(
            drawing(svg(distance_map(name, found.similarities, dataset)), f"Distances: {on}")
        )
        if dataset.positions_m is not None:
            threshold = found.best_match_curve.balanced_threshold
            figure = recognised_places(dataset, found.best_matches, threshold, name)
            section.paths.append(drawing(svg(figure), f"Recognised places on the way: {on}"))
        section.matches[name] = first_matches(dataset, found.best_matches)
        drawn()
    return section


def _curves(dataset: PlaceDataset, measured: dict[str, Measured]) -> list[Drawing]:
    pairs = {name: row.evaluation.pair_curve for name, row in measured.items()}
    best = {name: row.evaluation.best_match_curve for name, row in measured.items()}
    return [
        drawing(
            svg(precision_recall(curves, title)), f"Precision over recall, {title}: {dataset.name}"
        )
        for title, curves in (("all pairs", pairs), ("best match of each query", best))
    ]


def _best(measured: Sequence[Measured]) -> dict[int, float]:
    """Return the largest average precision on each dataset, by its identity."""
    best: dict[int, float] = {}
    for row in measured:
        key, value = id(row.dataset), row.evaluation.pair_curve.area
        best[key] = max(best.get(key, 0.0), value)
    return best


def _counted(total: int, progress: Progress | None) -> Callable[[], None]:
    done = 0

    def count() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, total)

    return count


def _versions() -> list[str]:
    found = [f"python {platform.python_version()}"]
    for package in PACKAGES:
        try:
            found.append(f"{package} {metadata.version(package)}")
        except metadata.PackageNotFoundError:
            continue
    return found
