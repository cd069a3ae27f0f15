# SPDX-License-Identifier: Apache-2.0
import base64
from dataclasses import replace

import pytest

from placerec.evaluation.report.page import PAPER, cost_figures, cost_rows


def named(measured, name, **cost):
    return replace(measured, recognizer=name, cost=replace(measured.cost, **cost))


def test_each_recognizer_once_as_first_measured_with_its_ratio_to_r_mac(measured):
    ours = named(measured, "ours", embed_ms=10.0, compare_ms=0.002, embedding_bytes=1024)
    other = named(measured, "ours", embed_ms=99.0)
    r_mac = named(measured, "R-MAC", embed_ms=40.0, compare_ms=0.001, embedding_bytes=2048)
    rows = cost_rows([ours, other, r_mac])
    assert [row.measured for row in rows] == [ours, r_mac]
    assert rows[0].ratios == pytest.approx((0.25, 2.0, 0.5))
    assert rows[1].ratios == (1.0, 1.0, 1.0)


def test_without_r_mac_there_is_no_ratio(measured):
    assert [row.ratios for row in cost_rows([measured])] == [None]
    assert cost_rows([]) == []


def test_the_papers_figures_stand_beside_ours(measured):
    figures = cost_figures(cost_rows([measured]))
    embed, compare, size = (
        base64.b64decode(figure.address.split(",")[1]).decode() for figure in figures
    )
    assert all(number in embed for number in (">12.3<", ">22<", ">1,694<", "paper: R-MAC"))
    assert all(number in compare for number in (">0.123<", ">18.9<"))
    assert all(number in size for number in (">2,048<", ">173,056<", ">4,000<"))
    assert [figure.alt for figure in figures][2] == "Bars: bytes per place"
    r_mac = next(row for row in PAPER if row.method == "R-MAC")
    assert (r_mac.embed_ms, r_mac.values) == (1694.0, 512)


def test_a_method_of_the_paper_is_known_however_it_is_written(measured):
    names = ["learned", "R-MAC", "HybridNet", "netvlad", "gradients"]
    found = [row.published for row in cost_rows([named(measured, name) for name in names])]
    assert [row and row.method for row in found] == [
        "AlexNet, 4096 values",
        "R-MAC",
        "AMOSNet, HybridNet",
        "NetVLAD",
        None,
    ]
    assert found[0].embed_ratio == pytest.approx(1 / 77)
    assert found[2].size_ratio == pytest.approx(256 * 13 * 13 / 512)
