# SPDX-License-Identifier: Apache-2.0
"""The bars that the project set itself, against what was measured."""

from collections.abc import Mapping, Sequence

from benchmarks.place_recognition.results import DEFAULT, Results
from benchmarks.place_recognition.sets import CORRIDOR, DESK, FLOORS
from benchmarks.place_recognition.tables import Check, markdown, relative, relative_mean
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


def checks(results: Results, costs: Mapping[str, Cost]) -> list[Check]:
    """Return all bars that can be measured here."""
    ours = results.seeds(MAIN_TRUNK, "multi-constraint")
    theirs = results.seeds(MAIN_TRUNK, "triplet")
    shipped = [DEFAULT] if DEFAULT in results.found else []
    listed = []
    for on in (DESK, FLOORS):
        own, other = results.precisions(ours, on), results.precisions(theirs, on)
        what = f"multi-constraint over triplet, average precision, {on}"
        gains, mean = relative(own, other), relative_mean(own, other)
        listed.append(Check(what, OVER_TRIPLET, gains, is_share=True, centre=mean))
    untrained = results.precisions([results.best_layer(MAIN_TRUNK)], DESK)[0]
    listed.append(
        Check(
            f"multi-constraint over the best untrained layer, average precision, {DESK}",
            OVER_UNTRAINED,
            [value / untrained - 1.0 for value in results.precisions(ours, DESK)],
            _first([value / untrained - 1.0 for value in results.precisions(shipped, DESK)]),
            is_share=True,
        )
    )
    for on, title, figure, bar in BARS:
        default = _first(results.values(shipped, on, figure))
        listed.append(Check(f"{on}: {title}", bar, results.values(ours, on, figure), default))
    fewer = results.precisions(["dimension-1000"], DESK)
    all_values = results.precisions(["dimension-4096"], DESK)
    losses = relative(fewer, all_values) if fewer and all_values else []
    what = f"4096 values to 1000, average precision, {DESK}, one seed"
    listed.append(Check(what, FEWER_VALUES, losses, is_share=True))
    for what, figure, bar, digits in COSTS:
        measured, timed = (
            [float(getattr(costs[name], figure))] if name in costs else []
            for name in (MAIN_TRUNK, DEFAULT)
        )
        listed.append(
            Check(what, bar, measured, _first(timed), is_at_most=True, unit=" ms", digits=digits)
        )
    return listed


def checks_table(listed: Sequence[Check]) -> str:
    """Return the checks as a Markdown table."""
    header = ("check", "bar", "seeds: mean (least to largest)", "", "shipped default", "")
    return markdown(header, [check.row for check in listed])


def _first(values: Sequence[float]) -> float | None:
    return values[0] if values else None
