# SPDX-License-Identifier: Apache-2.0
"""What recognizers cost, beside what the paper says of its methods (3.3.4, Figures 13 to 15)."""

from collections.abc import Sequence
from dataclasses import dataclass

from placerec.evaluation.figures import bars, svg
from placerec.evaluation.measurement import Cost, Measured
from placerec.evaluation.report.examples import PageFigure, page_figure

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
