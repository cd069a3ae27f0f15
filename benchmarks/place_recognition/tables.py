# SPDX-License-Identifier: Apache-2.0
"""Numbers as the page writes them, and whether they reach their bars."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean


@dataclass(frozen=True)
class Check:
    """A bar of the project, and what was measured against it.

    Attributes:
        what: the figure.
        bar: which it must reach.
        values: measured, one per seed; empty where it was not measured.
        shipped: measured with the shipped weights, None where that makes no sense.
        is_share: whether it is written in percent.
        is_at_most: whether it must not exceed the bar.
        unit: behind the numbers.
        digits: behind the point.
        centre: of the values, where it is not their mean.
    """

    what: str
    bar: float
    values: Sequence[float]
    shipped: float | None = None
    is_share: bool = False
    is_at_most: bool = False
    unit: str = ""
    digits: int = 3
    centre: float | None = None

    def is_met(self, value: float) -> bool:
        """Return whether a value reaches the bar."""
        return value <= self.bar if self.is_at_most else value >= self.bar

    @property
    def row(self) -> tuple[str, ...]:
        """The check as cells: what, bar, seeds, met or not, shipped, met or not."""
        sign = "≤" if self.is_at_most else "≥"
        cells = [self.what, f"{sign} {self._text(self.bar)}"]
        if self.values:
            centre = fmean(self.values) if self.centre is None else self.centre
            cells += [spread(self.values, self._text, centre), verdict(self.is_met(centre))]
        else:
            cells += ["not measured", ""]
        if self.shipped is None:
            return (*cells, "", "")
        return (*cells, self._text(self.shipped), verdict(self.is_met(self.shipped)))

    def _text(self, value: float) -> str:
        if self.is_share:
            return percent(value)
        return f"{value:.{self.digits}f}{self.unit}"


def verdict(is_met: bool) -> str:
    """Return what the page says of a bar."""
    return "met" if is_met else "**missed**"


def number(value: float) -> str:
    """Return a figure between 0 and 1."""
    return f"{value:.3f}"


def percent(value: float) -> str:
    """Return a share or a relative difference, with its sign."""
    return f"{100 * value:+.1f} %"


def spread(
    values: Sequence[float], text: Callable[[float], str] = number, centre: float | None = None
) -> str:
    """Return the centre, by default the mean, and, of several values, least and largest."""
    if len(values) < 2:
        return text(values[0]) if values else "–"
    middle = fmean(values) if centre is None else centre
    return f"{text(middle)} ({text(min(values))} to {text(max(values))})"


def relative(values: Sequence[float], others: Sequence[float]) -> list[float]:
    """Return by how much each value exceeds its counterpart, as a share of that."""
    return [value / other - 1.0 for value, other in zip(values, others, strict=True)]


def relative_mean(values: Sequence[float], others: Sequence[float]) -> float | None:
    """Return by how much the mean exceeds the others', as a share of that; None of nothing.

    A mean of shares would count most where the counterpart happens to be bad.
    """
    return fmean(values) / fmean(others) - 1.0 if values else None


def markdown(header: Sequence[str], rows: Sequence[Sequence[str]], names: int = 1) -> str:
    """Return a Markdown table; all columns but the first so many are numbers."""
    rules = ["---" if i < names else "---:" for i in range(len(header))]
    return "\n".join("| " + " | ".join(row) + " |" for row in (header, rules, *rows))
