# SPDX-License-Identifier: Apache-2.0
"""The page as a browser sees it: complete, self-contained, safe, and the same every time."""

import re
import shutil
import subprocess
from dataclasses import replace
from datetime import date
from html import escape
from html.parser import HTMLParser

import numpy as np
import pytest

from placerec.evaluation.measurement import Failed
from placerec.evaluation.report.page import render

VOID = {"meta", "link", "img", "br"}


class Page(HTMLParser):
    """Collects what the tests ask about, and checks that every tag is closed."""

    def __init__(self, text):
        super().__init__()
        self.tags, self.words, self.open = [], [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] != "style":
            self.words.append(data)

    @property
    def text(self):
        return " ".join(" ".join(self.words).split())

    def all(self, tag):
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture(scope="module")
def rows(measured):
    """Return a method that saw the data, one that fails, and both on a recording with positions.

    There the other one is the better and makes no error.
    """
    seen = replace(measured, weights="ImageNet", trained_on=("walk",), timed_on=date(2026, 2, 3))
    found = measured.evaluation
    perfect = replace(
        found,
        pair_curve=replace(found.pair_curve, precision=np.array([1.0, 0.75])),
        best_matches=replace(found.best_matches, are_right=np.array([True, True])),
    )
    ride = replace(measured.dataset, name="<ride>", positions_m=np.arange(12.0).reshape(4, 3) % 5)
    return [
        seen,
        Failed(measured.dataset, "other", "ValueError: <b>no</b>"),
        replace(measured, dataset=ride),
        replace(measured, dataset=ride, recognizer="other", evaluation=perfect),
    ]


@pytest.fixture(scope="module")
def text(rows):
    return render(rows)


@pytest.fixture(scope="module")
def page(text):
    return Page(text)


def test_all_is_there_and_every_tag_is_closed(page):
    assert page.open == []
    sections = [attributes["id"] for attributes in page.all("section")]
    assert sections == ["data1", "data2", "cost", "how"]
    assert [attributes["href"] for attributes in page.all("a")] == [f"#{s}" for s in sections]
    alts = [attributes["alt"] for attributes in page.all("img")]
    assert alts[:3] == [
        "Precision over recall, all pairs: walk",
        "Precision over recall, best match of each query: walk",
        "Which images of walk match",
    ]
    assert sum("Distances: " in alt for alt in alts) == 3
    assert [alt for alt in alts if "on the way" in alt] == [
        "Recognised places on the way: short on <ride>",
        "Recognised places on the way: other on <ride>",
    ]
    assert sum("beside" in alt for alt in alts) == 5  # a right and a wrong match of each but one
    assert sum(alt.startswith("Bars: ") for alt in alts) == 3


def test_figures_marks_and_failures_are_told(page):
    text = page.text
    assert "2 recognizers on 2 datasets" in text
    assert "walk: 4 images (0 skipped), 4 pairs count, 2 of them show one place" in text
    assert "0.750 0.50–0.90 0.500 0.12–0.60 0.250 0.500 0.750 0.625 ImageNet" in text
    assert "short trained on walk" in text
    assert "failed: ValueError: <b>no</b>" in text
    assert "12.3*" in text
    assert "AMOSNet, HybridNet – – – 43,264 173,056 84.5" in text
    assert "AlexNet, 4096 values 22 0.013 18.9 4,096 16,384 8" in text
    assert "the oldest on 2026-02-03" in text
    assert "short: first right match similarity 0.9000; 0.png ↔ 2.png" in text
    assert "other: no wrong match" in text


def test_the_papers_ratio_to_r_mac_stands_beside_the_measured_one(measured):
    rows = [replace(measured, recognizer=name) for name in ("amosnet", "r-mac")]
    text = Page(render(rows)).text
    assert "amosnet walk 12.3 1 – 0.123 1 512 2,048 1 84.5" in text
    assert "r-mac walk 12.3 1 1 0.123 1 512 2,048 1 1" in text


def test_the_best_of_a_column_is_bold(text):
    head = text[: text.index("<nav")]
    assert re.findall(r"<b>([\d.]+)</b>", head) == ["0.750", "0.875"]


def test_nothing_is_loaded_from_elsewhere(page, text):
    for _, attributes in page.tags:
        for name in ("src", "href", "srcset", "action"):
            assert (attributes.get(name) or "#").startswith(("data:", "#"))
    style = text[text.index("<style>") : text.index("</style>")]
    assert "url(" not in style
    assert "@import" not in style
    assert "<script" not in text


def test_the_same_measurements_give_the_same_page_and_progress_is_told(rows, text):
    seen = []
    assert render(rows, lambda *done: seen.append(done)) == text
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_a_page_where_all_failed_says_so(measured):
    page = Page(render([Failed(measured.dataset, "only", "no weights")]))
    assert page.open == []
    assert "failed: no weights" in page.text
    assert page.all("img") == []


@pytest.mark.skipif(shutil.which("chromium") is None, reason="needs chromium")
def test_on_a_phone_only_tables_scroll_sideways(text, tmp_path):
    measure = "document.title = this.contentDocument.documentElement.scrollWidth"
    phone = tmp_path / "phone.html"
    phone.write_text(
        f'<iframe width="400" height="900" onload="{measure}" srcdoc="{escape(text)}"></iframe>'
    )
    arguments = ["--headless", "--no-sandbox", "--disable-gpu", "--dump-dom", phone.as_uri()]
    shown = subprocess.run(
        ["chromium", *arguments], capture_output=True, text=True, timeout=120, check=True
    ).stdout
    width = re.search(r"<title>(\d+)</title>", shown)
    assert width
    assert 300 < int(width[1]) <= 400
