# SPDX-License-Identifier: Apache-2.0
"""The page as a browser sees it: complete, self-contained, safe, and the same every time."""

import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from placerec import drawing
from slam.evaluation.motion_truth import LoopTruth
from slam.output.report.page import write_report
from slam.result import SlamResult, ThresholdFit
from slam.types import RejectionReason, RelativePose, Trajectory

SECTIONS = (
    *("drift", "path", "loops", "recognizer", "places"),
    *("gallery", "decisions", "time", "settings"),
)
VOID = {"meta", "link", "img", "br", "path", "use", "rect", "image", "line", "circle", "stop"}


class Page(HTMLParser):
    """Collects what the tests ask about, and checks that every tag is closed."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.open: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if not self.open or self.open[-1] not in ("style", "script"):
            self.words.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self.words).split())

    def all(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


def render(*run: object, **more: object) -> str:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "report.html"
        write_report(path, *run, **more)
        return path.read_text(encoding="utf-8")


def page_of(result: SlamResult, drift: object = None, title: str = "a run", **more: object) -> Page:
    """Return a page whose figures are painted but not rendered, which takes the longest."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(drawing, "_save", lambda *_, **__: b"<svg></svg>")
        return Page(render(result, drift, "[loop]\n", title, **more))


@pytest.fixture(scope="module")
def text(run) -> str:
    return render(run.result, run.drift, "[loop]\ncandidates = 4\n", "fr1_desk", run.truth)


@pytest.fixture(scope="module")
def certified_text(certified) -> str:
    return render(certified.result, certified.drift, "", "certified", certified.truth)


@pytest.fixture(scope="module")
def page(text: str) -> Page:
    return Page(text)


def test_all_sections_are_there_and_every_tag_is_closed(page: Page) -> None:
    assert tuple(attributes["id"] for attributes in page.all("section")) == SECTIONS
    targets = [attributes["href"] for attributes in page.all("a")]
    assert targets == [f"#{section}" for section in SECTIONS]
    assert page.open == []


def test_nothing_is_loaded_from_elsewhere(page: Page, text: str) -> None:
    for tag, attributes in page.tags:
        for name in ("src", "href", "xlink:href", "srcset", "action", "poster"):
            address = attributes.get(name) or "#"
            assert address.startswith(("data:", "#")), (tag, name, address[:60])
    assert not re.search(r"@import|url\((?!#|\"?#)", text)


def test_pictures_have_words_for_those_who_cannot_see_them(page: Page) -> None:
    assert all(attributes.get("alt") for attributes in page.all("img"))
    drawings = page.all("svg")
    assert len(drawings) == 6
    assert all(attributes["role"] == "img" and attributes["aria-label"] for attributes in drawings)


def test_inner_references_of_the_drawings_are_unique_and_resolve(page: Page) -> None:
    identifiers = [attributes["id"] for _, attributes in page.tags if attributes.get("id")]
    assert len(identifiers) == len(set(identifiers))
    for _, attributes in page.tags:
        address = attributes.get("xlink:href") or ""
        if address.startswith("#"):
            assert address[1:] in identifiers


def test_the_conditions_stand_beside_the_errors(page: Page) -> None:
    for words in (
        "at most 20 ms away",
        "SE(3)",
        "1 (not estimated",
        "Smoothing none",
        "100.0 % of the sequence",
    ):
        assert words in page.text
    assert "ground truth" in page.text


def test_every_trajectory_has_its_row_of_errors(run, page: Page) -> None:
    drift = run.drift
    for name, error in (
        ("Odometry, live", drift.odometry),
        ("Corrected, live", drift.live),
        ("In the end, without loops", drift.without_loops),
        ("In the end, with loops", drift.corrected),
    ):
        assert f"{name} {error.ate_rmse_m:.4f} m {error.rpe_translation_m:.4f} m," in page.text
    assert "The same, smoothed" not in page.text


def test_live_frames_too_few_to_compare_are_said_to_be(run) -> None:
    page = page_of(run.result, replace(run.drift, live=None))
    assert "Corrected, live too few frames" in page.text


def test_what_is_smoothed_is_named(run, altered) -> None:
    smoothed = replace(run.drift.corrected, ate_rmse_m=0.0123)
    page = page_of(altered(), replace(run.drift, smoothed=smoothed))
    assert "The same, smoothed 0.0123 m" in page.text
    assert "Smoothing none but in the last row" in page.text


def test_nees_stands_beside_what_it_should_be(page: Page) -> None:
    assert "median NEES of links 5.0, of loops 5.4. 5.35 is right; more: errors" in page.text


def test_error_over_time_is_drawn_of_odometry_and_without_loops_and_corrected(text: str) -> None:
    drawing = text.split('aria-label="Position error', 1)[1].split("</svg>", 1)[0]
    for name in ("odometry", "without loops", "corrected"):
        assert f">{name}</text>" in drawing
    for colour in ("before", "without", "after"):
        assert f"var(--{colour})" in drawing


def test_a_run_is_as_long_as_its_clock_says_though_its_stages_overlap(page: Page, run) -> None:
    assert sum(run.result.stage_seconds.values()) == pytest.approx(5.3)
    assert "4.0 s in all" in page.text


def test_same_run_same_bytes(run, text: str) -> None:
    again = render(run.result, run.drift, "[loop]\ncandidates = 4\n", "fr1_desk", run.truth)
    assert again == text


def test_words_from_outside_cannot_become_markup(altered) -> None:
    evil = "<script>alert(1)</script>"
    result = altered(warnings=(evil,), stage_seconds={evil: 1.0})
    page = Page(render(result, None, evil, evil))
    assert len(page.all("script")) == 1
    assert page.text.count("alert(1)") == 5  # title, heading, warning, stage, settings


def test_without_truth_it_says_that_no_error_can_be_given(run) -> None:
    page = page_of(run.result)
    assert "No ATE can be given" in page.text
    assert "RPE RMSE" not in page.text
    assert "by the corrected trajectory" in page.text


def test_warnings_come_before_the_first_section(altered) -> None:
    text = render(altered(warnings=("The depth scale looks wrong.",)), None, "", "a run")
    assert text.index("The depth scale looks wrong.") < text.index("<section")


@pytest.mark.parametrize("keyframes", [1, 2, 13])
def test_a_run_without_any_attempt_has_a_page(make: Callable, keyframes: int) -> None:
    run = make(keyframes, attempts=0)
    page = Page(render(run.result, run.drift, "", "a run", truth=run.truth))
    assert "no loop was tried" in page.text
    assert page.all("article") == []


def test_nan_similarities_are_left_blank(run, altered) -> None:
    blank = np.full_like(run.result.similarities, np.nan)
    attempts = tuple(replace(one, similarity=np.nan) for one in run.result.attempts)
    page = page_of(altered(similarities=blank, attempts=attempts), run.drift)
    assert "similarity –" in page.text


def test_all_rejected_and_untracked_frames(run, altered) -> None:
    rejected = tuple(
        one for one in run.result.attempts if not isinstance(one.outcome, RelativePose)
    )
    lost = np.array([3.33, 3.36, 25.0])
    page = Page(render(altered(attempts=rejected, untracked_s=lost), None, "", "a run"))
    assert f"0 of {len(rejected)} candidates were accepted" in page.text
    assert "200 of 203" in page.text
    assert "not tracked" in page.text


def test_no_frame_tracked_but_the_first(altered, make: Callable) -> None:
    run = make(1, attempts=0)
    one = Trajectory(run.truth.timestamps_s[:1], run.truth.T_world_cam[:1])
    same = dict.fromkeys(("odometry", "live", "without_loops", "trajectory"), one)
    result = replace(run.result, **same, stage_seconds={})
    assert "1 of 1" in page_of(result).text


def test_what_the_recognizer_was_calibrated_on(certified_text: str) -> None:
    page = Page(certified_text)
    for words in (
        "from 0.750, 95 % interval 0.700 to 0.800: 1 % of the pairs of different places are",
        "in the kind of scene where they are least alike, and 37.0 % of those of one place",
        "from 0.870, 95 % interval 0.620 to 0.890: 0.1 % of the pairs of different places are so",
        "where they are most alike, and 12.0 % of those of one place (5.0 % to 16.0 %)",
        "1000 draws of places",
        "ie_tower:validation 288, 3 more could not be read 26127 540 0.750, 0.870 0.780: 0.4 %",
        "0.3 % pass, 75.0 % are cut",
        "rooms 288 26127 540 0.780, 0.850",
        f"sha256:{'0123456789abcdef' * 4}",
    ):
        assert words in page.text
    assert "this run verified from" not in page.text
    assert "tau 0.870" in certified_text and "verified from 0.750" in certified_text
    assert len(page.all("svg")) == 7


def test_live_similarities_stand_beside_the_calibrated_range(certified) -> None:
    live = np.array([-0.5, 0.0, 0.8, 0.99, 0.74], np.float32)
    calibration = replace(certified.result.calibration, live_similarities=live)
    page = page_of(replace(certified.result, calibration=calibration))
    told = (
        "of 5 pairs that could be loops, 40.0 % reach 0.750 and 40.0 % lie outside -0.240 to 0.950"
    )
    assert told in page.text
    thinned = replace(calibration, step=25)
    page = page_of(replace(certified.result, calibration=thinned))
    assert "of 5 pairs that could be loops of one keyframe in 25, 40.0 % reach 0.750" in page.text


def test_a_run_that_verified_from_another_similarity_says_so(certified) -> None:
    page = page_of(replace(certified.result, min_similarity=0.5))
    assert "this run verified from 0.500" in page.text


def test_a_threshold_is_told_with_its_reliability(certified) -> None:
    fit = ThresholdFit(0.5, 0.75, 40, 900, 0.03, 0.6)
    page = page_of(replace(certified.result, min_similarity=0.5, threshold=fit))
    assert "of 0.500 (40 pairs of one place and 900 others met" in page.text
    assert "60% of those of different places pass" in page.text


def test_a_certificate_without_any_pair_to_compare_has_a_page(certified) -> None:
    nothing = np.empty(0, np.float32)
    calibration = replace(certified.result.calibration, live_similarities=nothing)
    page = page_of(replace(certified.result, calibration=calibration))
    assert "of 0 pairs that could be loops, – % reach 0.750" in page.text


def test_without_a_certificate_one_line_says_so(page: Page) -> None:
    assert "This recognizer has no certificate: nothing is known of the data on" in page.text
    assert "Worth verifying" not in page.text


def test_every_reason_can_be_filtered(page: Page) -> None:
    kinds = {attributes.get("data-kind") for attributes in page.all("button")}
    shown = {attributes["data-kind"] for attributes in page.all("article")}
    assert kinds == shown | {""}
    assert {"accepted", RejectionReason.FEW_INLIERS.name.lower()} <= shown


def test_the_file_is_replaced_as_a_whole(run, tmp_path: Path) -> None:
    target = tmp_path / "report.html"
    target.write_text("old")
    write_report(target, run.result, run.drift, "", "a run")
    assert target.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]


@pytest.mark.skipif(shutil.which("chromium") is None, reason="chromium is not installed")
def test_a_browser_has_nothing_to_complain_about(certified_text: str, tmp_path: Path) -> None:
    script = """<script>
        for (const one of document.querySelectorAll("button, summary")) one.click();
        document.title = `width ${document.documentElement.scrollWidth}`;
    </script>"""
    page = certified_text.replace("</body>", script + "</body>")
    (tmp_path / "report.html").write_text(page)
    command = ["chromium", "--headless", "--no-sandbox", "--disable-gpu", "--dump-dom"]
    command += ["--window-size=500,900", "--hide-scrollbars"]
    command += ["--enable-logging=stderr", f"--user-data-dir={tmp_path / 'profile'}"]
    command.append((tmp_path / "report.html").as_uri())
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=True)
    assert "CONSOLE" not in done.stderr
    assert "<title>width 500</title>" in done.stdout  # nothing sticks out of a narrow window


def test_what_truth_cannot_judge_is_called_neither_right_nor_false(run) -> None:
    drift = replace(
        run.drift,
        loops=tuple(LoopTruth() for _ in run.drift.loops),
        unjudged="the truth has no orientations",
    )
    text = render(run.result, drift, "[loop]\n", "a run", run.truth)
    assert "none false" not in text
    assert "not known" in text and "not covered" not in text
