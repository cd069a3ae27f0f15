# SPDX-License-Identifier: Apache-2.0
"""Numbers and tables as the page writes them, and the bars that the project set itself."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from statistics import fmean

from benchmarks.place_recognition.measured import CORRIDOR, DEFAULT, DESK, FLOORS, Results
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


def checks_table(results: Results, costs: Mapping[str, Cost]) -> str:
    """Return all bars that can be measured here as a Markdown table."""
    header = ("check", "bar", "seeds: mean (least to largest)", "", "shipped default", "")
    return markdown(header, list(_checks(results, costs)))


def _checks(results: Results, costs: Mapping[str, Cost]) -> Iterator[tuple[str, ...]]:
    ours = results.seeds(MAIN_TRUNK, "multi-constraint")
    theirs = results.seeds(MAIN_TRUNK, "triplet")
    for on in (DESK, FLOORS):
        own, other = results.precisions(ours, on), results.precisions(theirs, on)
        what = f"multi-constraint over triplet, average precision, {on}"
        gains, mean = relative(own, other), relative_mean(own, other)
        yield check(what, OVER_TRIPLET, gains, text=percent, centre=mean)
    untrained = results.precisions([results.best_layer(MAIN_TRUNK)], DESK)[0]
    measured, default = (
        [value / untrained - 1.0 for value in results.precisions(names, DESK)]
        for names in (ours, [DEFAULT])
    )
    what = f"multi-constraint over the best untrained layer, average precision, {DESK}"
    yield check(what, OVER_UNTRAINED, measured, default, text=percent)
    for on, title, figure, bar in BARS:
        measured, default = (results.values(names, on, figure) for names in (ours, [DEFAULT]))
        yield check(f"{on}: {title}", bar, measured, default)
    fewer, most = (results.precisions([f"dimension-{n}"], DESK) for n in (1000, 4096))
    what = f"4096 values to 1000, average precision, {DESK}, one seed"
    losses = relative(fewer, most) if fewer and most else []
    yield check(what, FEWER_VALUES, losses, text=percent)
    for what, figure, bar, digits in COSTS:
        measured, default = (
            [float(getattr(costs[name], figure))] if name in costs else []
            for name in (MAIN_TRUNK, DEFAULT)
        )
        ms = f"{{:.{digits}f}} ms".format
        yield check(what, bar, measured, default, text=ms, is_at_most=True)


def check(
    what: str,
    bar: float,
    values: Sequence[float],
    shipped: Sequence[float] = (),
    *,
    text: Callable[[float], str] = number,
    is_at_most: bool = False,
    centre: float | None = None,
) -> tuple[str, ...]:
    """Return a bar and what was measured against it as six cells.

    Args:
        what: the figure.
        bar: which it must reach.
        values: measured, one per seed; empty where it was not measured.
        shipped: the one value of the shipped weights; empty where that makes no sense.
        text: writes a value.
        is_at_most: whether it must not exceed the bar.
        centre: of the values, where it is not their mean.
    """

    def verdict(value: float) -> str:
        return "met" if (value <= bar if is_at_most else value >= bar) else "**missed**"

    measured = ("not measured", "")
    if values:
        middle = fmean(values) if centre is None else centre
        measured = (spread(values, text, middle), verdict(middle))
    default = (text(shipped[0]), verdict(shipped[0])) if shipped else ("", "")
    return what, f"{'≤' if is_at_most else '≥'} {text(bar)}", *measured, *default
