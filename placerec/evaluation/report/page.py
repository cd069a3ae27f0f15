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
    bars,
    distance_map,
    precision_recall,
    recognised_places,
    svg,
    truth_map,
)
from placerec.evaluation.measurement import Cost, Failed, Measured, Measurement
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


# What recognizers cost, beside what the paper says of its methods (3.3.4, Figures 13 to 15).
_R_MAC = "rmac"
"""The recognizer that the paper measures by, without regard to hyphens and capitals."""
_FLOAT_BYTES = 4
_R_MAC_EMBED_MS, _R_MAC_VALUES = 77 * 22.0, 512
"""It takes "almost 77 times" as long as AlexNet's 22 ms."""


@dataclass(frozen=True)
class Published:
    """What the paper's text says of a method; None where it says nothing.

    Attributes:
        method: its name there.
        recognizers: what it is called here, without regard to hyphens and capitals.
        embed_ms: to extract the features of a pair of images.
        compare_ms: to compare a pair.
        values: numbers in a feature vector.
    """

    method: str
    recognizers: tuple[str, ...]
    embed_ms: float | None
    compare_ms: float | None
    values: int | None

    @property
    def embed_ratio(self) -> float | None:
        """How many times R-MAC's time to extract."""
        return None if self.embed_ms is None else self.embed_ms / _R_MAC_EMBED_MS

    @property
    def size_ratio(self) -> float | None:
        """How many times R-MAC's numbers in a vector."""
        return None if self.values is None else self.values / _R_MAC_VALUES


PAPER = (
    Published("AlexNet, 4096 values", ("learned",), 22.0, 0.0189, 4096),
    Published("AlexNet or VGG16, 1000 values", (), None, None, 1000),
    Published("R-MAC", (_R_MAC,), _R_MAC_EMBED_MS, None, _R_MAC_VALUES),
    Published("NetVLAD", ("netvlad",), None, None, 4096),
    Published("AMOSNet, HybridNet", ("amosnet", "hybridnet"), None, None, 256 * 13 * 13),
)


@dataclass(frozen=True)
class CostRow:
    """A recognizer's cost beside the paper's.

    Attributes:
        measured: the recognizer.
        ratios: how many times R-MAC's cost that is: time to embed, to compare, size; None where
            R-MAC was not measured.
        published: the same method in the paper, None where it is not there.
    """

    measured: Measured
    ratios: tuple[float, float, float] | None
    published: Published | None


def cost_rows(rows: Sequence[Measured]) -> list[CostRow]:
    """Return each recognizer's cost on the first dataset that it was measured on."""
    first: dict[str, Measured] = {}
    for row in rows:
        first.setdefault(row.recognizer, row)
    r_mac = next((row.cost for name, row in first.items() if _plain(name) == _R_MAC), None)
    published = {name: method for method in PAPER for name in method.recognizers}
    return [
        CostRow(row, _ratios(row.cost, r_mac) if r_mac else None, published.get(_plain(name)))
        for name, row in first.items()
    ]


def cost_figures(rows: Sequence[CostRow]) -> list[PageFigure]:
    """Return time to embed, time to compare and size as bars, the paper's in grey below."""
    costs = {row.measured.recognizer: row.measured.cost for row in rows}
    quantities = (
        (
            "ms to embed an image (paper: a pair)",
            {name: cost.embed_ms for name, cost in costs.items()},
            {row.method: row.embed_ms for row in PAPER if row.embed_ms},
        ),
        (
            "µs to compare a pair",
            {name: 1e3 * cost.compare_ms for name, cost in costs.items()},
            {row.method: 1e3 * row.compare_ms for row in PAPER if row.compare_ms},
        ),
        (
            "bytes per place",
            {name: float(cost.embedding_bytes) for name, cost in costs.items()},
            {row.method: float(_FLOAT_BYTES * row.values) for row in PAPER if row.values},
        ),
    )
    return [
        page_figure(svg(bars(measured, label, paper)), f"Bars: {label}")
        for label, measured, paper in quantities
    ]


def _plain(name: str) -> str:
    return name.replace("-", "").lower()


def _ratios(cost: Cost, unit: Cost) -> tuple[float, float, float]:
    return (
        cost.embed_ms / unit.embed_ms,
        cost.compare_ms / unit.compare_ms,
        cost.embedding_bytes / unit.embedding_bytes,
    )
