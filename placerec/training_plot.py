# SPDX-License-Identifier: Apache-2.0
"""The picture of a training's log."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from placerec.output_file import write_atomically
from placerec.training_log import StepRecord

SMOOTHED_SHARE = 0.05
"""Share of all steps that a point of the smooth line is the mean of."""
STEP_COLOUR, MEAN_COLOUR = "#b8c4d0", "#1f5fa8"


def write_plot(records: Sequence[StepRecord], path: Path) -> None:
    """Write loss and share of sets that still cost something, step by step, as a PNG file.

    Raises:
        RecognizerError: it cannot be written.
    """
    steps = np.array([record.step for record in records])
    figure = Figure(figsize=(7.0, 5.0), dpi=120, layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True)
    curves = {
        "loss": (upper, [record.loss for record in records]),
        "sets with a loss": (lower, [record.active_share for record in records]),
    }
    for title, (axes, values) in curves.items():
        axes.plot(steps, values, color=STEP_COLOUR, linewidth=0.8, label="per step")
        axes.plot(steps, _smooth(np.array(values)), color=MEAN_COLOUR, label="moving mean")
        axes.set_ylabel(title)
        axes.set_ylim(bottom=0.0)
        axes.grid(alpha=0.3)
        axes.spines[["top", "right"]].set_visible(False)
    upper.legend(frameon=False, loc="upper right")
    lower.set_xlabel("step")
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", metadata={"Software": None})
    write_atomically(path, buffer.getvalue())


def _smooth(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (N,) means of what lies around each of (N,) values, fewer towards the ends."""
    half = int(SMOOTHED_SHARE * len(values) / 2.0)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    middle = np.arange(len(values))
    start, stop = np.maximum(middle - half, 0), np.minimum(middle + half + 1, len(values))
    means: NDArray[np.float64] = (sums[stop] - sums[start]) / (stop - start)
    return means
