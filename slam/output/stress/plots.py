# SPDX-License-Identifier: Apache-2.0
"""The tolerance curves: what becomes of a run the more is wrong, one row for each thing."""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from placerec.evaluation.drawing import AFTER, BEFORE, INK, SOFT, WRONG, canvas, png, svg
from slam.output.stress.outcome import Outcome
from slam.output.stress.stressors import STRESSORS
from slam.output.stress.tolerance import Trials, is_tolerated

_WIDTH_IN, _ROW_IN, _LEGENDS_IN = 8.0, 1.75, 0.9
_MOST_TIMES = 30.0  # the median of what is drawn, before the axis is logarithmic
_FAILED = "not tolerated: over 110 %, or under 90 % of the frames"


def curves(clean: Outcome, trials: Trials) -> dict[str, bytes]:
    """Return the SVG and PNG files by name; there has to be a trial."""
    with canvas(_ROW_IN * len(trials) + _LEGENDS_IN, _WIDTH_IN) as figure:
        axes = figure.subplots(len(trials), 2, squeeze=False)
        for (name, some), (errors, shares) in zip(trials.items(), axes, strict=True):
            levels = [0.0, *(each.level for each in some)]
            _draw_errors(errors, levels, [clean, *some])
            _draw_shares(shares, levels, [clean, *some])
            errors.set_title(name, loc="left", fontweight="bold")
            for each in (errors, shares):
                each.set_xlabel(STRESSORS[name].unit, fontsize=8.5)
                each.set_xticks(range(len(levels)), [f"{level:g}" for level in levels])
        for column, place in ((0, "outside upper left"), (1, "outside upper right")):
            figure.legend(*axes[0, column].get_legend_handles_labels(), loc=place, fontsize=8.5)
        return {"tolerance.svg": svg(figure), "tolerance.png": png(figure)}


def _draw_errors(axes: Axes, levels: Sequence[float], outcomes: Sequence[Outcome]) -> None:
    clean = outcomes[0]
    kind = "ATE" if clean.has_truth else "from the clean run"
    x = np.arange(len(levels))
    without, with_loops = (
        np.array([np.nan if value is None else value for value in values], float)
        for values in (
            [each.ate_without_loops_m for each in outcomes],
            [each.ate_m for each in outcomes],
        )
    )
    axes.plot(x, without, "o--", color=BEFORE, ms=4, label=f"{kind}, without loops")
    axes.plot(x, with_loops, "o-", color=AFTER, ms=4, label=f"{kind}, with loops")
    if clean.has_truth and clean.ate_m:
        axes.axhline(clean.ate_m, color=SOFT, lw=1.0, ls=":", label="the clean run, with loops")
    failed = np.array([not is_tolerated(clean, each) for each in outcomes])
    axes.plot(x[failed], with_loops[failed], "o", ms=9, mfc="none", color=WRONG, label=_FAILED)
    axes.margins(y=0.12)
    known = np.concatenate([without, with_loops])
    known = known[np.isfinite(known)]
    if len(known) and known.max() > _MOST_TIMES * max(np.median(known), 1e-9):
        axes.set_yscale("log")
    else:
        axes.set_ylim(bottom=0)
    axes.set_ylabel("m")


def _draw_shares(axes: Axes, levels: Sequence[float], outcomes: Sequence[Outcome]) -> None:
    x = np.arange(len(levels))
    most = max(1, outcomes[0].loops_kept)
    in_use = [max(1, each.loops_kept + each.false_kept) for each in outcomes]
    tracked = [each.tracked_share for each in outcomes]
    kept = [each.loops_kept / most for each in outcomes]
    false = [each.false_kept / count for each, count in zip(outcomes, in_use, strict=True)]
    axes.plot(x, tracked, "s--", color=INK, ms=4, label="frames tracked")
    axes.plot(x, kept, "o-", color=AFTER, ms=4, label="right loops, to the clean run's")
    axes.plot(x, false, "^-", color=WRONG, ms=4, label="false, of the loops in use")
    axes.set_ylim(-0.05, max(1.05, 1.05 * max(kept)))
    axes.set_ylabel("share")
