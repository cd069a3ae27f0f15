# SPDX-License-Identifier: Apache-2.0
import pytest

from benchmarks.place_recognition.tables import (
    check,
    markdown,
    percent,
    relative,
    relative_mean,
    spread,
)


def test_a_bar_is_met_by_the_mean_of_the_seeds_not_by_the_best_of_them():
    what = ("recall", "≥ 0.700", "0.690 (0.600 to 0.750)", "**missed**", "0.700", "met")
    assert check("recall", 0.70, [0.60, 0.75, 0.72], shipped=[0.70]) == what


def test_a_cost_must_not_exceed_its_bar():
    row = check("embed", 25.0, [], shipped=[25.1], text="{:.1f} ms".format, is_at_most=True)
    assert row == ("embed", "≤ 25.0 ms", "not measured", "", "25.1 ms", "**missed**")


def test_a_loss_of_more_than_the_bar_is_missed():
    assert check("dimension", -0.05, [-0.08], text=percent)[1:4] == (
        "≥ -5.0 %",
        "-8.0 %",
        "**missed**",
    )


def test_differences_are_relative_to_the_counterpart():
    assert relative([0.3, 0.2], [0.2, 0.4]) == pytest.approx([0.5, -0.5])
    with pytest.raises(ValueError):
        relative([0.3], [])


def test_a_spread_of_nothing_is_a_dash_and_of_one_value_that_value():
    assert spread([]) == "–"
    assert spread([0.25]) == "0.250"


def test_numbers_stand_to_the_right():
    table = markdown(("a", "b"), [("x", "1")])
    assert table.splitlines() == ["| a | b |", "| --- | ---: |", "| x | 1 |"]


def test_one_bad_counterpart_does_not_make_the_mean_difference():
    ours, theirs = [0.3, 0.3], [0.1, 0.3]
    assert relative_mean(ours, theirs) == pytest.approx(0.5)
    gains = check("gain", 0.6, relative(ours, theirs), text=percent, centre=0.5)
    assert gains[2:4] == ("+50.0 % (+0.0 % to +200.0 %)", "**missed**")
    assert relative_mean([], []) is None
