# SPDX-License-Identifier: Apache-2.0
import numpy as np

from placerec.evaluation.figures import bars, dimension_comparison, precision_recall
from placerec.evaluation.precision_recall import Curve

GOOD = Curve(np.array([0.9, 0.5]), np.array([1.0, 0.75]), np.array([0.25, 1.0]))
POOR = Curve(np.array([0.7]), np.array([0.5]), np.array([0.5]))


def labels(figure):
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def test_a_curve_per_method_with_the_area_below_it():
    figure = precision_recall({"good": GOOD, "poor": POOR}, "all pairs")
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel(), axes.get_title()) == (
        "recall",
        "precision",
        "all pairs",
    )
    good, poor = axes.lines
    assert good.get_xydata().tolist() == [[0.0, 1.0], [0.25, 1.0], [1.0, 0.75]]
    assert poor.get_xydata().tolist() == [[0.0, 0.5], [0.5, 0.5]]
    assert labels(figure) == [f"good  {GOOD.area:.3f}", "poor  0.250"]
    assert good.get_color() != poor.get_color()
    assert axes.get_xlim() == (0.0, 1.0)


def test_more_methods_get_more_room_for_their_names():
    few, many = (precision_recall({f"method {i}": GOOD for i in range(count)}) for count in (2, 12))
    assert len(labels(many)) == 12
    assert many.get_figheight() > few.get_figheight() + 2.0


def test_precision_over_dimension_goes_through_the_means():
    figure = dimension_comparison(
        {"ours": {4096: [0.4, 0.5, 0.45], 1000: [0.4]}, "triplet": {2500: [0.3, 0.2]}}
    )
    (axes,) = figure.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("dimension", "average precision")
    ours, triplet = axes.containers
    assert np.allclose(ours.lines[0].get_xydata(), [[1000, 0.4], [4096, 0.45]])
    assert np.allclose(triplet.lines[0].get_xydata(), [[2500, 0.25]])
    spread = ours.lines[2][0].get_segments()  # from the least run to the best
    assert np.allclose([segment[:, 1] for segment in spread], [[0.4, 0.4], [0.4, 0.5]])
    assert [label.get_text() for label in axes.get_xticklabels()] == ["1000", "2500", "4096"]
    assert labels(figure) == ["ours", "triplet"]


def test_a_bar_per_method_then_those_of_the_paper():
    figure = bars({"ours": 12.34, "R-MAC": 880.0}, "ms per image", {"R-MAC": 1694.0})
    (axes,) = figure.axes
    assert [bar.get_width() for bar in axes.patches] == [12.34, 880.0, 1694.0]
    names = [label.get_text() for label in axes.get_yticklabels()]
    assert names == ["ours", "R-MAC", "paper: R-MAC"]
    assert [text.get_text() for text in axes.texts] == ["12.3", "880", "1,694"]
    assert axes.get_xlabel() == "ms per image"
    assert axes.get_xscale() == "log"
    top, bottom = axes.patches[0].get_y(), axes.patches[2].get_y()
    assert axes.transData.transform((1.0, top))[1] > axes.transData.transform((1.0, bottom))[1]


def test_the_paper_is_grey_and_may_be_left_out():
    figure = bars({"ours": 0.02}, "ms per pair", {"theirs": 0.0189})
    ours, theirs = (bar.get_facecolor()[:3] for bar in figure.axes[0].patches)
    assert ours != theirs
    assert max(theirs) - min(theirs) < 0.07
    assert len(bars({"ours": 0.02}, "ms per pair").axes[0].patches) == 1
