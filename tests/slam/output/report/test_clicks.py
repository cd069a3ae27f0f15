# SPDX-License-Identifier: Apache-2.0
"""The page in a real browser: what can be clicked answers, at every width, and on paper."""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from slam.output.decision import decisions
from slam.output.report.page import write_report
from slam.types import Influence

EVIL = "</script><script>document.title = 'broken'</script>"
WIDTHS = (400, 1280, 1920)


@pytest.fixture(scope="module")
def page(certified, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("page") / "report.html"
    ids = np.arange(len(certified.result.keyframes))
    attempts = tuple(
        replace(each, influence=Influence(ids, np.full((len(ids), 3), 1e-3 * n, np.float32), 1.0))
        if each.rejection is None
        else each
        for n, each in enumerate(certified.result.attempts)
    )
    result = replace(certified.result, warnings=(EVIL,), attempts=attempts)
    write_report(path, result, certified.drift, f"# {EVIL}\n", EVIL)
    return path


@pytest.fixture(scope="module")
def opened(browser, page: Path) -> Iterator[object]:
    """Return the browser with the page open, and see afterwards that it had nothing to say."""
    browser.open(page)
    yield browser
    assert browser.complaints == []
    assert all(url.startswith(("file:", "data:", "blob:")) for url in browser.requests)


def chosen(browser) -> str:
    return browser.run("el('pairname').textContent")


def choose(browser, identifier: str, value: str) -> None:
    browser.run(
        f"(() => {{ const it = document.getElementById('{identifier}'); it.value = '{value}';"
        "for (const name of ['input', 'change']) it.dispatchEvent(new Event(name)); })()"
    )
    browser.settle()


def click_on(browser, selector: str) -> None:
    """Click with the mouse in the middle of an element."""
    x, y = browser.run(
        f"(() => {{ const it = document.querySelector(`{selector}`);"
        "it.scrollIntoView({block: 'center', behavior: 'instant'});"
        "const box = it.getBoundingClientRect();"
        "return [box.x + box.width / 2, box.y + box.height / 2]; })()"
    )
    browser.click(x, y)


def shown_path(browser) -> float:
    """Return a number that tells where the path is drawn."""
    return browser.run("el('scene').data[4].x.reduce((sum, x) => sum + (x ?? 0), 0)")


def test_the_most_doubtful_loop_is_shown_first(opened, certified) -> None:
    first = next(
        one for one in decisions(certified.result, certified.drift) if one.kind == "outvoted"
    )
    assert chosen(opened) == f"Keyframes {first.match.id} and {first.query.id}"
    assert "contradicts the rest" in opened.run("el('numbers').textContent")


def test_every_attempt_shows_its_two_images_and_its_numbers(opened, certified) -> None:
    seen = opened.run(
        "[...document.querySelectorAll('#loops tbody button')].map(button => { button.click();"
        "return [el('pairname').textContent,"
        "document.querySelectorAll('#views image').length,"
        "document.querySelectorAll('#numbers dd').length]; })"
    )
    loops = decisions(certified.result, certified.drift)
    wanted = {f"Keyframes {one.match.id} and {one.query.id}" for one in loops}
    assert {name for name, _, _ in seen} == wanted
    assert all(images == 2 and numbers >= 5 for _, images, numbers in seen)


def test_a_row_is_chosen_with_the_mouse_and_with_the_keyboard(opened) -> None:
    click_on(opened, "#loops tbody tr:nth-child(3) button")
    third = chosen(opened)
    opened.run("document.querySelector('#loops tbody tr:nth-child(4) button').focus()")
    opened.press("Enter")
    assert chosen(opened) != third
    click_on(opened, "#previous")
    assert chosen(opened) == third


def test_a_loop_in_the_matrix_is_clicked(opened) -> None:
    point = "#matrix .scatterlayer .trace:last-child .point:last-of-type"
    click_on(opened, "#loops tbody tr:first-child button")
    before = chosen(opened)
    opened.run("el('matrix').scrollIntoView({block: 'center'})")
    click_on(opened, point)
    assert chosen(opened) != before


def test_a_triangle_in_the_drift_plot_is_clicked(opened) -> None:
    click_on(opened, "#loops tbody tr:first-child button")
    before = chosen(opened)
    click_on(opened, "#chart .scatterlayer .trace:nth-child(4) .point:nth-of-type(2)")
    assert chosen(opened) != before


MIDDLE_OF_OUTVOTED = """(() => {
    const { x, y, z } = el("scene").data[6];
    return picking.projection(el("scene"))([x[1], y[1], z[1]]);
})()"""


def test_a_loop_in_space_is_clicked(opened) -> None:
    """The diamond in the middle of the first outvoted loop, wherever it is on the screen."""
    click_on(opened, "#loops tbody tr:first-child button")
    outvoted = chosen(opened)
    click_on(opened, "#loops tbody tr:last-child button")
    assert chosen(opened) != outvoted
    opened.run("el('scene').scrollIntoView({block: 'center', behavior: 'instant'})")
    opened.settle()
    opened.click(*opened.run(MIDDLE_OF_OUTVOTED))
    assert chosen(opened) == outvoted


def test_the_slider_moves_the_path_and_the_map(opened) -> None:
    after, name = shown_path(opened), "el('stagename').value"
    assert opened.run(name) == "with loops"
    choose(opened, "stage", "0")
    assert opened.run(name) == "odometry"
    assert shown_path(opened) != after
    choose(opened, "stage", "2")
    assert shown_path(opened) == after


def test_errors_are_shown_as_colour_and_as_large_as_wanted(opened) -> None:
    usual = shown_path(opened)
    choose(opened, "enlargement", "50")
    assert shown_path(opened) != usual
    assert "50 times as large" in opened.run("el('enlarged').textContent")
    choose(opened, "colour", "error")
    worst = opened.run("Math.max(...el('scene').data[4].line.color)")
    errors = opened.run("Math.max(...floats(data.frames.curves[2].lengths))")
    assert worst == pytest.approx(errors, rel=1e-4)


def test_what_is_zoomed_to_in_the_drift_plot_is_marked_in_space(opened) -> None:
    opened.run("void Plotly.relayout('chart', {'xaxis.range': [5, 10]})")
    opened.settle()
    marked = opened.run("el('scene').data[3].x.filter(x => x !== null).length")
    assert marked == 51
    click_on(opened, "#whole")
    marked = opened.run("el('scene').data[3].x.filter(x => x !== null).length")
    assert marked == 0


def test_the_frame_under_the_pointer_is_marked_in_space(opened) -> None:
    x, y, time_s = opened.run(
        "(() => { const { xaxis, yaxis } = el('chart')._fullLayout;"
        "el('chart').scrollIntoView({block: 'center', behavior: 'instant'});"
        "const box = el('chart').getBoundingClientRect(), { x, y } = el('chart').data[0];"
        "return [box.x + xaxis._offset + xaxis.d2p(x[150]),"
        "box.y + yaxis._offset + yaxis.d2p(y[150]), x[150]]; })()"
    )
    opened.settle()
    opened.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
    opened.settle()
    marked = opened.run("[...el('scene').data[10].x]")
    frame = opened.run(f"frames.times_s.findIndex(s => Math.abs(s - {time_s}) < 1e-3)")
    assert marked == [opened.run(f"el('scene').data[4].x[{frame}]")]


@pytest.mark.parametrize("measure", ["lengths", "per_metre"])
@pytest.mark.parametrize("along", ["times_s", "travelled_m"])
def test_drift_is_drawn_over_time_and_along_the_path(opened, measure: str, along: str) -> None:
    choose(opened, "measure", measure)
    choose(opened, "along", along)
    known = opened.run("el('chart').data[2].y.filter(y => y >= 0).length")
    assert known > 100
    last = opened.run(f"frames.{along}.at(-1)")
    assert opened.run("el('chart').data[0].x.at(-1)") == last


def test_the_view_is_turned_by_keys_and_by_name_and_stays_so(opened) -> None:
    eye = "Object.values(el('scene')._fullLayout.scene._scene.getCamera().eye)"
    first = opened.run(eye)
    opened.run("el('scene').focus()")
    opened.press("ArrowLeft")
    turned = opened.run(eye)
    assert np.linalg.norm(turned) == pytest.approx(np.linalg.norm(first))
    assert np.abs(np.subtract(turned, first)).max() > 0.05
    choose(opened, "viewpoint", "above")
    choose(opened, "colour", "time")
    assert np.abs(opened.run(eye)).argmax() == 1  # along the axis that is up


def test_filter_and_order(opened) -> None:
    choose(opened, "filter", "accepted")
    kinds = opened.run(
        "[...document.querySelectorAll('#loops tbody tr')].filter(row => !row.hidden)"
        ".map(row => row.className)"
    )
    assert kinds and all(kind.startswith("accepted") for kind in kinds)
    choose(opened, "filter", "")
    for order in ("similarity", "influence"):
        choose(opened, "order", order)
        values = opened.run(
            "[...document.querySelectorAll('#loops tbody tr')]"
            f".map(row => +row.dataset.{order} || 0)"
        )
        assert values == sorted(values, reverse=True) and values[0] > 0.0
    opened.run("document.querySelector('#loops tbody button').click()")
    assert "Left out" in opened.run("document.getElementById('numbers').textContent")


def test_no_button_sends_anything_anywhere(opened) -> None:
    titles = opened.run(
        "[...document.querySelectorAll('.modebar-btn')].map(each => each.dataset.title)"
    )
    assert "Download plot" in titles
    assert not any("hare" in title or "loud" in title for title in titles)


def test_words_from_outside_do_nothing(opened) -> None:
    assert opened.run("document.title").startswith("</script><script>")


@pytest.mark.parametrize("width", WIDTHS)
def test_nothing_sticks_out_by_day_or_by_night(opened, page: Path, width: int) -> None:
    opened.open(page, width)
    for theme, ink in (("light", "#20242a"), ("dark", "#e6e9ed")):
        features = [{"name": "prefers-color-scheme", "value": theme}]
        opened.call("Emulation.setEmulatedMedia", features=features)
        opened.settle()
        assert opened.run("el('chart')._fullLayout.font.color") == ink
        assert opened.run("document.documentElement.scrollWidth") == width
        ends = opened.run(
            "[...document.querySelectorAll('nav a')].map(a => a.getBoundingClientRect().right)"
        )
        assert max(ends) <= width


def test_on_paper_it_is_short_and_has_path_and_table(opened, page: Path) -> None:
    opened.open(page)
    opened.call("Emulation.setEmulatedMedia", media="print", features=[])
    visible = "(name) => document.querySelector(name).getClientRects().length > 0"
    for name in ("#flatpath", ".flat + .flat", "#loops table", "#views", "pre"):
        assert opened.run(f"({visible})('{name}')"), name
    assert not opened.run(f"({visible})('#scene')")
    opened.call("Emulation.setEmulatedMedia", media="")
    assert len(re.findall(rb"/Type\s*/Page\b", opened.paper())) <= 5


def test_a_run_without_images_and_loops_has_a_page(opened, make, tmp_path: Path) -> None:
    result = make(13, attempts=0).result
    bare = [replace(each.preview, depth_m=0 * each.preview.depth_m) for each in result.keyframes]
    keyframes = tuple(map(lambda each, seen: replace(each, preview=seen), result.keyframes, bare))
    write_report(tmp_path / "bare.html", replace(result, keyframes=keyframes), None, "", "bare")
    opened.open(tmp_path / "bare.html")
    assert opened.run("el('scene').data[4].x.length") == 65
    assert opened.complaints == []


def test_without_webgl_the_path_is_drawn_flat(browser_without_webgl, page: Path) -> None:
    browser = browser_without_webgl
    browser.open(page)
    assert browser.complaints == []
    assert "no WebGL" in browser.run("el('nowebgl').textContent")
    assert browser.run("el('flatpath').getClientRects().length") == 1
    click_on(browser, "#loops tbody tr:nth-child(2) button")
    assert chosen(browser) != ""
