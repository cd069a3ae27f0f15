# SPDX-License-Identifier: Apache-2.0
"""The bars that the project set itself, against what was measured."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import fmean

from benchmarks.place_recognition.measured import CORRIDOR, DEFAULT, DESK, FLOORS, Results
from benchmarks.place_recognition.tables import markdown, percent, relative, relative_mean, spread
from benchmarks.place_recognition.trainings import MAIN_TRUNK
from placerec.evaluation.measurement import Cost

OVER_TRIPLET, OVER_UNTRAINED, FEWER_VALUES = 0.19, 0.27, -0.05
BARS = (
    (DESK, "recall@1", "recall_at_1", 0.70),
    (DESK, "recall at 100 % precision", "recall_at_full_precision", 0.30),
    (CORRIDOR, "recall@1", "recall_at_1", 0.92),
    (CORRIDOR, "area under the best-match curve", "best_match_area", 0.85),
)
COSTS = (
    ("embedding an image, median, one thread", "embed_ms", 25.0, 1),
    ("comparing two embeddings, in a batch of 10,000", "compare_ms", 0.001, 5),
)


@dataclass(frozen=True)
class Check:
    """A bar of the project, and what was measured against it.

    Attributes:
        what: the figure.
        bar: which it must reach.
        values: measured, one per seed; empty where it was not measured.
        shipped: the one value of the shipped weights; empty where that makes no sense.
        is_share: whether it is written in percent.
        is_at_most: whether it must not exceed the bar.
        unit: behind the numbers.
        digits: behind the point.
        centre: of the values, where it is not their mean.
    """

    what: str
    bar: float
    values: Sequence[float]
    shipped: Sequence[float] = ()
    is_share: bool = False
    is_at_most: bool = False
    unit: str = ""
    digits: int = 3
    centre: float | None = None

    @property
    def row(self) -> tuple[str, ...]:
        """The check as cells: what, bar, seeds, met or not, shipped, met or not."""
        sign = "≤" if self.is_at_most else "≥"
        cells = [self.what, f"{sign} {self._text(self.bar)}"]
        if self.values:
            centre = fmean(self.values) if self.centre is None else self.centre
            cells += [spread(self.values, self._text, centre), self._verdict(centre)]
        else:
            cells += ["not measured", ""]
        if not self.shipped:
            return (*cells, "", "")
        return (*cells, self._text(self.shipped[0]), self._verdict(self.shipped[0]))

    def _verdict(self, value: float) -> str:
        is_met = value <= self.bar if self.is_at_most else value >= self.bar
        return "met" if is_met else "**missed**"

    def _text(self, value: float) -> str:
        if self.is_share:
            return percent(value)
        return f"{value:.{self.digits}f}{self.unit}"


def checks_table(results: Results, costs: Mapping[str, Cost]) -> str:
    """Return all bars that can be measured here as a Markdown table."""
    header = ("check", "bar", "seeds: mean (least to largest)", "", "shipped default", "")
    return markdown(header, [check.row for check in _checks(results, costs)])


def _checks(results: Results, costs: Mapping[str, Cost]) -> Iterator[Check]:
    ours = results.seeds(MAIN_TRUNK, "multi-constraint")
    theirs = results.seeds(MAIN_TRUNK, "triplet")
    for on in (DESK, FLOORS):
        own, other = results.precisions(ours, on), results.precisions(theirs, on)
        what = f"multi-constraint over triplet, average precision, {on}"
        gains, mean = relative(own, other), relative_mean(own, other)
        yield Check(what, OVER_TRIPLET, gains, is_share=True, centre=mean)
    untrained = results.precisions([results.best_layer(MAIN_TRUNK)], DESK)[0]
    measured, default = (
        [value / untrained - 1.0 for value in results.precisions(names, DESK)]
        for names in (ours, [DEFAULT])
    )
    what = f"multi-constraint over the best untrained layer, average precision, {DESK}"
    yield Check(what, OVER_UNTRAINED, measured, default, is_share=True)
    for on, title, figure, bar in BARS:
        measured, default = (results.values(names, on, figure) for names in (ours, [DEFAULT]))
        yield Check(f"{on}: {title}", bar, measured, default)
    fewer, most = (results.precisions([f"dimension-{n}"], DESK) for n in (1000, 4096))
    what = f"4096 values to 1000, average precision, {DESK}, one seed"
    losses = relative(fewer, most) if fewer and most else []
    yield Check(what, FEWER_VALUES, losses, is_share=True)
    for what, figure, bar, digits in COSTS:
        measured, default = (
            [float(getattr(costs[name], figure))] if name in costs else []
            for name in (MAIN_TRUNK, DEFAULT)
        )
        yield Check(what, bar, measured, default, is_at_most=True, unit=" ms", digits=digits)
