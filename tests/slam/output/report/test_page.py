# SPDX-License-Identifier: Apache-2.0
"""The page as a browser sees it: complete, self-contained, safe, and the same every time."""

import json
import re
import tempfile
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from importlib import resources
from pathlib import Path

import numpy as np
import pytest

from slam.evaluation.motion_truth import LoopTruth
from slam.output.decision import decisions
from slam.output.report import page_data
from slam.output.report.page import write_report
from slam.output.summary import summarise
from slam.result import MapMesh, MapMeshes, SlamResult, ThresholdFit
from slam.types import RejectionReason, RelativePose, Trajectory

SECTIONS = ("explore", "drift", "places", "recognizer", "losses", "time", "settings")
VOID = {"meta", "link", "img", "br", "path", "use", "rect", "image", "line", "circle", "input"}


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


def render(*run: object) -> str:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "report.html"
        write_report(path, *run)
        return path.read_text(encoding="utf-8")


def page_of(result: SlamResult, drift: object = None, title: str = "a run") -> Page:
    return Page(render(result, drift, "[loop]\n", title))


def data_of(text: str) -> dict[str, object]:
    """Return what the page's script reads."""
    return json.loads(text.split('id="data">', 1)[1].split("</script>", 1)[0])


@pytest.fixture(scope="module")
def text(run) -> str:
    return render(run.result, run.drift, "[loop]\ncandidates = 4\n", "fr1_desk")


@pytest.fixture(scope="module")
def certified_text(certified) -> str:
    return render(certified.result, certified.drift, "", "certified")


@pytest.fixture(scope="module")
def page(text: str) -> Page:
    return Page(text)


def test_all_sections_are_there_and_every_tag_is_closed(page: Page) -> None:
    assert tuple(attributes["id"] for attributes in page.all("section")) == SECTIONS
    targets = [attributes["href"] for attributes in page.all("a")]
    assert targets == ["#explore", *(f"#{section}" for section in SECTIONS)]
    assert page.open == []


def with_meshes(result: SlamResult, before: float | None, after: float) -> SlamResult:
    picture = np.full((54, 72, 3), 90, np.uint8)
    of = [entropy and MapMesh(entropy, 0.01, picture, picture) for entropy in (before, after)]
    meshes = MapMeshes(of[0], of[1], 7)
    return replace(result, meshes=meshes, warnings=meshes.warnings)


def test_meshes_are_shown_before_and_after_with_how_sharp_they_are(run) -> None:
    page = page_of(with_meshes(run.result, -5.0, -5.5), run.drift)
    assert "map entropy -5.000 before, -5.500 after: sharper" in page.text
    pictures = page.all("img")
    assert [each["alt"] for each in pictures] == [
        "The whole, from above, before loop closure.",
        "The whole, from above, after loop closure.",
        "Closer, where keyframe 7 looked, before loop closure.",
        "Closer, where keyframe 7 looked, after loop closure.",
    ]
    assert all(each["src"].startswith("data:image/jpeg;base64,/9j/") for each in pictures)
    assert "#map" in [each.get("href") for each in page.all("a")]
    assert "Before you trust" not in page.text and page.open == []


def test_a_map_that_is_less_sharp_after_is_not_passed_over(run) -> None:
    text = page_of(with_meshes(run.result, -5.5, -5.0), run.drift).text
    assert "Before you trust this result the map is less sharp after loop closure" in text
    assert "not sharper" in text


def test_one_mesh_is_shown_alone(run) -> None:
    page = page_of(with_meshes(run.result, None, -5.0), run.drift)
    assert "no loop was closed, so there is one mesh only" in page.text
    assert len(page.all("img")) == 2 and "before along" not in page.text


def test_nothing_is_loaded_from_elsewhere(page: Page, text: str) -> None:
    for tag, attributes in page.tags:
        for name in ("src", "href", "xlink:href", "srcset", "action", "poster"):
            address = attributes.get(name) or "#"
            assert address.startswith(("data:", "#")), (tag, name, address[:60])
    style = text.split("<style>", 1)[1].split("</style>", 1)[0]
    assert not re.search(r"@import|url\(", style)
    (policy,) = [each["content"] for each in page.all("meta") if "http-equiv" in each]
    assert policy.startswith("default-src 'none'")


def test_drawings_have_words_for_those_who_cannot_see_them(page: Page) -> None:
    drawn = [each for each in page.all("svg") if each.get("id") != "views"]  # that gets its own
    plots = [each for each in page.all("div") if each.get("class") == "plot"]
    assert (len(drawn), len(plots)) == (2, 3)
    assert all(each["role"] == "img" and each["aria-label"] for each in (*drawn, *plots))


def test_names_of_elements_are_unique(page: Page) -> None:
    identifiers = [attributes["id"] for _, attributes in page.tags if attributes.get("id")]
    assert len(identifiers) == len(set(identifiers))


def test_figures_are_those_of_the_summary(run, page: Page) -> None:
    summary = summarise(run.result, run.drift)
    assert f"Error (ATE RMSE) {1000 * summary['ate_corrected_m']:.2f} mm" in page.text
    assert f"{summary['loops_accepted']} of {summary['loops_tried']}" in page.text
    for name in ("odometry", "live", "without_loops", "corrected"):
        assert f"{summary[f'ate_{name}_m']:.4f} m" in page.text
        assert f"{summary[f'rpe_rotation_{name}_deg']:.3f}°" in page.text
    assert f"{summary['frames_tracked']} of 200" in page.text


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


def test_a_run_is_as_long_as_its_clock_says_though_its_stages_overlap(page: Page, run) -> None:
    assert sum(run.result.stage_seconds.values()) == pytest.approx(5.3)
    assert "the whole run 20.00 4.00" in page.text and "compiling" not in page.text


def test_what_the_compiler_took_of_a_run_is_told(altered) -> None:
    assert (
        "compiling, which later runs need not do 15.00 3.00"
        in page_of(altered(compiling_s=3.0)).text
    )


def test_where_no_time_is_known_none_is_told(altered) -> None:
    page = page_of(altered(elapsed_s=None, stage_seconds={}))
    assert "Wall time" not in page.text and "ms per frame" not in page.text
    assert not any(each.get("href") == "#time" for each in page.all("a"))


def test_same_run_same_bytes(run, text: str) -> None:
    again = render(run.result, run.drift, "[loop]\ncandidates = 4\n", "fr1_desk")
    assert again == text


EVIL = "</script><script>alert(1)</script><!--<script>\u2028{{ 7 * 7 }}"


def test_words_from_outside_cannot_become_markup(run, altered, monkeypatch) -> None:
    monkeypatch.setattr(page_data, "_motion", lambda _: EVIL)
    result = altered(warnings=(EVIL,), stage_seconds={EVIL: 1.0})
    text = render(result, replace(run.drift, unjudged=EVIL), EVIL, EVIL)
    page = Page(text)
    assert len(page.all("script")) == 3
    # title, heading, warning, what of truth is not known, stage, settings
    assert page.text.count("alert(1)") == 6
    assert "{{ 7 * 7 }}" in page.text
    assert {loop["motion"] for loop in data_of(text)["loops"]} == {EVIL}


def test_words_of_a_recognizer_cannot_become_markup(certified) -> None:
    calibration = certified.result.calibration
    evil = calibration.certificate.model_copy(update={"recognizer": EVIL})
    kinds = tuple(kind.model_copy(update={"data": EVIL}) for kind in evil.kinds)
    evil = evil.model_copy(update={"kinds": kinds})
    result = replace(certified.result, calibration=replace(calibration, certificate=evil))
    page = page_of(result)
    assert len(page.all("script")) == 3
    assert page.text.count("alert(1)") == 3


def test_without_truth_it_says_that_no_error_can_be_given(run) -> None:
    page = page_of(run.result)
    assert "Error (ATE RMSE) not known no ground truth to compare with" in page.text
    assert "Before you trust" not in page.text
    assert "how far loop closure moved each frame" in page.text
    assert "by the corrected path" in page.text


def test_warnings_come_before_the_first_section(altered) -> None:
    text = render(altered(warnings=("The depth scale looks wrong.",)), None, "", "a run")
    assert text.index("The depth scale looks wrong.") < text.index("<section")


@pytest.mark.parametrize("keyframes", [1, 2, 13])
def test_a_run_without_any_attempt_has_a_page(make: Callable, keyframes: int) -> None:
    run = make(keyframes, attempts=0)
    page = page_of(run.result, run.drift)
    assert "no loop was tried" in page.text
    assert page.all("tbody") != [] and "↔" not in page.text


def test_nan_similarities_are_left_blank(run, altered) -> None:
    blank = np.full_like(run.result.similarities, np.nan)
    attempts = tuple(replace(one, similarity=np.nan) for one in run.result.attempts)
    text = render(altered(similarities=blank, attempts=attempts), run.drift, "", "a run")
    assert {loop["similarity"] for loop in data_of(text)["loops"]} == {None}
    assert "NaN" not in text.split('id="data">', 1)[1].split("</script>", 1)[0]


def test_all_rejected_and_untracked_frames(run, altered) -> None:
    rejected = tuple(
        one for one in run.result.attempts if not isinstance(one.outcome, RelativePose)
    )
    lost = np.array([3.33, 3.36, 25.0])
    page = page_of(altered(attempts=rejected, untracked_s=lost))
    assert f"0 of {len(rejected)} candidates were accepted" in page.text
    assert "200 of 203" in page.text
    assert "3.33 3.36 2 not tracked 25.00 25.00 1 not tracked" in page.text


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
    told = data_of(certified_text)
    assert told["calibration"]["threshold"] == 0.87 and told["min_similarity"] == 0.75
    assert sum(told["calibration"]["counts"]) == 630  # pairs


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
    assert "This run there are no pairs to compare with it" in page.text


def test_without_a_certificate_one_line_says_so(page: Page) -> None:
    assert "This recognizer has no certificate: nothing is known of the data on" in page.text
    assert "Worth verifying" not in page.text


def test_every_attempt_is_listed_and_every_reason_can_be_filtered(run, page: Page) -> None:
    loops = decisions(run.result, run.drift)
    rows = [each["class"].split() for each in page.all("tr") if each.get("data-time")]
    assert len(rows) == len(loops)
    kinds = {attributes.get("value") for attributes in page.all("option")}
    assert {row[0] for row in rows} == {loop.kind for loop in loops} <= kinds
    assert {"accepted", RejectionReason.FEW_INLIERS.name.lower()} <= kinds
    assert [row[0] for row in rows[:2]] == ["outvoted", "outvoted"] and rows[0][1] == "doubtful"


def test_the_library_comes_with_its_licence_and_cannot_end_its_script() -> None:
    vendored = resources.files("slam.output.report").joinpath("page", "vendored")
    library = vendored.joinpath("plotly-gl3d.min.js").read_text("utf-8")
    assert "Licensed under the MIT license" in library[:300]
    assert "</script" not in library.lower() and "<!--" not in library
    assert vendored.joinpath("plotly.LICENSE").read_text("utf-8").startswith("MIT License")


def test_the_file_is_replaced_as_a_whole(run, tmp_path: Path) -> None:
    target = tmp_path / "report.html"
    target.write_text("old")
    write_report(target, run.result, run.drift, "", "a run")
    assert target.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert [file.name for file in tmp_path.iterdir()] == ["report.html"]


def test_what_truth_cannot_judge_is_called_neither_right_nor_false(run) -> None:
    drift = replace(
        run.drift,
        loops=tuple(LoopTruth() for _ in run.drift.loops),
        unjudged="the truth has no orientations",
    )
    text = render(run.result, drift, "[loop]\n", "a run")
    assert "none false" not in text
    assert "truth not known" in text and "not covered" not in text
    assert 'value="per_metre"' not in text
