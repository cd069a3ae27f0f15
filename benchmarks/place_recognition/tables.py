# SPDX-License-Identifier: Apache-2.0
"""Numbers as the page writes them."""

from collections.abc import Callable, Sequence
from statistics import fmean


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
