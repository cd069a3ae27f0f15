# SPDX-License-Identifier: Apache-2.0
"""Drawings of which keyframes look alike and which are really near each other."""

from typing import Any

import numpy as np
from markupsafe import Markup
from matplotlib.axes import Axes
from numpy.typing import NDArray

from placerec.drawing import AFTER, BEFORE, INK, TRUTH, WRONG, draw
from slam.output.decision import ACCEPTED, FALSE, OUTVOTED, Decision
from slam.output.report.paths import Paths
from slam.result import Calibration, SlamResult, compared

_REJECTED = "rejected"
_MARKERS = {
    _REJECTED: ("x", BEFORE, 5.0, 1.0),
    OUTVOTED: ("D", BEFORE, 4.5, 1.0),
    ACCEPTED: ("o", AFTER, 4.5, 1.5),
    FALSE: ("D", WRONG, 6.0, 2.0),
}


def similarity_matrix(result: SlamResult, loops: list[Decision]) -> Markup:
    """Draw how similar all keyframes look, with the loop attempts on top."""
    size = len(result.keyframes)
    alt = "Heat map of the similarity of all pairs of keyframes, with accepted and rejected loops"
    return _matrix("similarity", alt, result.similarities, size, "similarity", "Greys", loops)


def distance_matrix(paths: Paths, loops: list[Decision]) -> Markup:
    """Draw how far apart all keyframes are: in truth where known, else as corrected."""
    size = len(paths.keyframes_m)
    points = paths.keyframe_truth_m if paths.has_keyframe_truth else paths.keyframes_m
    points = points[:: compared(size).step]
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    source = "ground truth" if paths.has_keyframe_truth else "the corrected trajectory"
    alt = f"Heat map of the distance between all pairs of keyframes by {source}"
    return _matrix("distance", alt, distances, size, "distance (m)", "Greys_r", loops)


def _matrix(
    name: str,
    alt: str,
    values: NDArray[np.floating[Any]],
    size: int,
    label: str,
    colours: str,
    loops: list[Decision],
) -> Markup:
    """Draw a square matrix over keyframe ids 0 to size - 1, blank where NaN.

    The attempts are marked below the diagonal: row = query, column = earlier match.
    """

    def paint(axes: Axes) -> None:
        image = axes.imshow(
            np.ma.masked_invalid(values),
            cmap=colours,
            interpolation="none",
            extent=(-0.5, size - 0.5, size - 0.5, -0.5),
        )
        axes.grid(visible=False)
        axes.set_xlabel("earlier keyframe")
        axes.set_ylabel("later keyframe")
        bar = axes.figure.colorbar(
            image, ax=axes, label=label, location="bottom", shrink=0.7, aspect=35
        )
        bar.ax.locator_params(nbins=5)
        pairs: dict[str, list[tuple[int, int]]] = {group: [] for group in _MARKERS}
        for loop in loops:
            group = loop.kind if loop.kind in _MARKERS else _REJECTED
            pairs[group].append((loop.match.id, loop.query.id))
        for group, (marker, colour, marker_size, width) in _MARKERS.items():
            if count := len(pairs[group]):
                axes.plot(
                    *np.transpose(pairs[group]),
                    marker,
                    color=colour,
                    ms=marker_size,
                    mew=width,
                    mfc="none",
                    label=f"{group} ({count})",
                    rasterized=count > 3000,
                )

    return draw(name, alt, paint, height_in=5.6)


def similarity_histogram(loops: list[Decision], min_similarity: float) -> Markup:
    """Draw how similar the accepted and the rejected candidates looked."""
    values = np.array([loop.attempt.similarity for loop in loops])
    is_known = np.isfinite(values)
    is_kept = np.array([loop.kind in (ACCEPTED, FALSE) for loop in loops])
    groups = [values[is_known & ~is_kept], values[is_known & is_kept]]
    seen = [*values[is_known], min_similarity]
    bins = np.linspace(min(seen) - 1e-3, max(seen) + 1e-3, 31).tolist()

    def paint(axes: Axes) -> None:
        names = ["rejected", "accepted"]
        axes.hist(groups, bins=bins, stacked=True, color=[BEFORE, AFTER], label=names)
        threshold = f"threshold {min_similarity:.3f}"
        axes.axvline(min_similarity, color=INK, lw=1.2, ls="--", label=threshold)
        axes.set_xlabel("similarity")
        axes.locator_params(axis="x", nbins=5)
        axes.set_ylabel("candidates")

    return draw("histogram", "Histogram of similarity of accepted and rejected candidates", paint)


def calibrated_range(calibration: Calibration, min_similarity: float) -> Markup:
    """Draw how similar the keyframes look beside where the recognizer was calibrated."""
    certificate, live = calibration.certificate, calibration.live_similarities
    marks = (*certificate.calibrated_range, certificate.threshold, min_similarity)
    low, high = float(live.min(initial=min(marks))), float(live.max(initial=max(marks)))
    bins = np.linspace(low - 1e-3, high + 1e-3, 61).tolist()
    bars = (
        (certificate.different_places, 1.16, BEFORE, "different places"),
        (certificate.same_place, 1.07, AFTER, "one place"),
    )

    def paint(axes: Axes) -> None:
        counts, _, _ = axes.hist(live, bins=bins, color=TRUTH, label="in this run")
        top = max(float(np.max(counts)), 1.0)
        for (start, stop), height, colour, label in bars:
            axes.hlines(height * top, start, stop, color=colour, lw=7, label=label)
        lines = ((min_similarity, "--", "verified from"), (certificate.threshold, ":", "tau"))
        for value, style, name in lines:
            axes.axvline(value, color=INK, lw=1.2, ls=style, label=f"{name} {value:.3f}")
        axes.set_ylim(0, 1.22 * top)
        axes.set_xlabel("similarity")
        axes.set_ylabel("pairs of keyframes")

    alt = (
        "Histogram of the similarity of keyframes, below bars for where the calibration's pairs lay"
    )
    return draw("calibrated", alt, paint)
