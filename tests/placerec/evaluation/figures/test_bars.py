# SPDX-License-Identifier: Apache-2.0
from placerec.evaluation.figures import bars


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
