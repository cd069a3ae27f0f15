# SPDX-License-Identifier: Apache-2.0
"""The results page, docs/place_recognition.md: what was measured, in the words of a template."""

import os
import platform
import re
from collections.abc import Mapping, Sequence
from dataclasses import astuple, replace
from importlib.metadata import version
from pathlib import Path

from jinja2 import Environment, StrictUndefined

from benchmarks.place_recognition.contenders import GRADIENTS
from benchmarks.place_recognition.figures import Figures
from benchmarks.place_recognition.measured import DEFAULT, Results, collect
from benchmarks.place_recognition.tables import (
    checks_table,
    markdown,
    number,
    percent,
    relative,
    relative_mean,
    spread,
)
from benchmarks.place_recognition.trainings import (
    DIMENSIONS,
    LOSSES,
    MAIN_TRUNK,
    PAPERS,
    RECIPE,
    TRUNK_PLANS,
    compared_name,
    planned_trainings,
)
from placerec.datasets import PlaceDataset
from placerec.evaluation.embeddings import embed_dataset
from placerec.evaluation.measurement import Cost, measure_cost
from placerec.files import write_atomically
from placerec.recognizer import PlaceRecognizer
from placerec.recognizers.gradients import GradientRecognizer
from placerec.recognizers.learned import LearnedRecognizer
from placerec.training.log import read_log
from placerec.training.loop import LOG_NAME

TEMPLATE = Path(__file__).with_name("page.md.j2")
LIBRARIES = ("torch", "numpy", "opencv-python-headless")
MAIN = compared_name(MAIN_TRUNK, "multi-constraint", 0)
FIGURES = ("average precision", "recall@1", "recall at 100 % P", "best-match area")
TIMED_IMAGES = 50


def write_page(
    data: Path, validation: Path, trunk_weights: Path, runs: Path, default: Path, docs: Path
) -> None:
    """Measure what there is, and write the page and its figures.

    Raises:
        RecognizerError: data or weights cannot be read, or a file cannot be written.
    """
    results = collect(data, validation, trunk_weights, runs, default)
    images = docs / "images" / "places"
    text = render({**_tables(results, runs), **_figures(results, runs, default, images)})
    write_atomically(docs / "place_recognition.md", text.encode())
    print(f"written to {docs / 'place_recognition.md'}")


def render(contents: Mapping[str, object]) -> str:
    """Return the page: the template with its tables and figures."""
    # Markdown is no HTML: nothing is to be escaped.
    environment = Environment(
        undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True, keep_trailing_newline=True
    )
    return environment.from_string(TEMPLATE.read_text(encoding="utf-8")).render(contents)


def _tables(results: Results, runs: Path) -> dict[str, object]:
    cpuinfo = Path("/proc/cpuinfo")
    model = re.search(r"model name\s*: (.+)", cpuinfo.read_text() if cpuinfo.exists() else "")
    versions = [f"{name} {version(name)}" for name in LIBRARIES]
    return {
        "recipe": RECIPE,
        "losses": _losses_tables(results),
        "untrained": _untrained_table(results),
        "experiments": _experiments_table(results),
        "dimensions": _dimensions_table(results),
        "budget": _budget_table(runs),
        "machine": f"{model[1] if model else platform.processor()}, {os.cpu_count()} cores",
        "versions": ", ".join([f"python {platform.python_version()}", *versions]),
    }


def _figures(results: Results, runs: Path, default: Path, folder: Path) -> dict[str, object]:
    figures = Figures(folder)
    legend = {
        DEFAULT: DEFAULT,
        "multi-constraint": MAIN,
        "triplet": compared_name(MAIN_TRUNK, "triplet", 0),
        "start of the training": f"{MAIN_TRUNK}-start",
        "untrained layer": results.best_layer(MAIN_TRUNK),
        GRADIENTS: GRADIENTS,
    }
    methods = {
        title: results.found[name] for title, name in legend.items() if name in results.found
    }
    desk = results.sets[0].datasets[0]
    on_desk = {title: each.similarities[desk.name] for title, each in methods.items()}
    ways = [title for title in (DEFAULT, "multi-constraint", "triplet") if title in methods]
    costs = _costs(results, runs, default, desk)
    return {
        "checks": checks_table(results, costs),
        "curves": {each.name: figures.curves(each, methods) for each in results.sets},
        "distances": figures.distances(desk, on_desk),
        "ways": [figures.way(title, desk, on_desk[title]) for title in ways],
        "dimension_figure": figures.dimensions(_dimension_series(results)),
        "cost_figures": figures.costs(costs),
        "costs": markdown(
            ("", "ms per image", "ms per comparison", "values", "bytes"),
            [
                (n, f"{c.embed_ms:.1f}", f"{c.compare_ms:.5f}", *map(str, astuple(c)[2:]))
                for n, c in costs.items()
            ],
        ),
    }


def _costs(results: Results, runs: Path, default: Path, dataset: PlaceDataset) -> dict[str, Cost]:
    """Return what embedding takes, an image at a time as `run_slam` does it, and comparing."""
    files = {planned.name: planned.weights(runs) for planned in planned_trainings()}
    files[DEFAULT] = default
    titles = {DEFAULT: DEFAULT}
    titles |= {compared_name(trunk, "multi-constraint", 0): trunk for trunk in TRUNK_PLANS}
    titles |= {f"dimension-{n}": f"{MAIN_TRUNK}, {n} values" for n in DIMENSIONS}
    recognizers: dict[str, PlaceRecognizer] = {
        title: LearnedRecognizer(files[name])
        for name, title in titles.items()
        if name in results.found
    }
    recognizers[GRADIENTS] = GradientRecognizer()
    some = replace(dataset, paths=dataset.paths[:TIMED_IMAGES])
    embedded = {name: embed_dataset(each, some) for name, each in recognizers.items()}
    return {name: measure_cost(each.embeddings, each.seconds) for name, each in embedded.items()}


def _losses_tables(results: Results) -> dict[str, str]:
    """Return multi-constraint against triplet, a table per trunk and the paper's conditions."""
    groups = {trunk: (trunk, trunk) for trunk in TRUNK_PLANS}
    groups[f"{MAIN_TRUNK}, under the paper's conditions"] = (PAPERS, MAIN_TRUNK)
    tables = {}
    for title, (group, trunk) in groups.items():
        ours, theirs = (results.seeds(group, loss) for loss in LOSSES)
        if ours:
            start, layer = f"{group}-start", results.best_layer(trunk)
            tables[title] = _losses_table(results, ours, theirs, start, layer)
    return tables


def _losses_table(
    results: Results, ours: Sequence[str], theirs: Sequence[str], start: str, layer: str
) -> str:
    rows = []
    for on in (each.name for each in results.sets):
        mine, other = results.precisions(ours, on), results.precisions(theirs, on)
        before, untrained = (results.precisions([name], on) for name in (start, layer))
        gain = spread(relative(mine, other), percent, relative_mean(mine, other))
        rows.append((on, spread(mine), spread(other), gain, spread(before), spread(untrained)))
    which = layer.split(maxsplit=1)[1]
    return markdown(
        ("average precision", "multi-constraint", "triplet", "difference", "start", which), rows
    )


def _untrained_table(results: Results) -> str:
    names = [name for trunk in TRUNK_PLANS for name in results.layers[trunk]]
    best = {results.best_layer(trunk) for trunk in TRUNK_PLANS}
    rows = [
        (f"**{name}**" if name in best else name, *_precisions(results, name)) for name in names
    ]
    return markdown(("untrained layer", *(each.name for each in results.sets)), rows)


def _experiments_table(results: Results) -> str:
    titles = {
        DEFAULT: DEFAULT,
        MAIN: "the recipe, seed 0",
        "with-fr1_xyz": "with fr1_xyz among the data",
        "papers-margins": "the paper's margins",
        "papers-pooling": "the paper's flattened maps",
        f"{MAIN_TRUNK}-start": "no step at all",
        GRADIENTS: GRADIENTS,
    }
    rows = [
        (title, each.name, *map(number, results.found[name].scores[each.name]))
        for name, title in titles.items()
        if name in results.found
        for each in results.sets
    ]
    return markdown(("", "on", *FIGURES), rows, names=2)


def _dimensions_table(results: Results) -> str:
    names = {f"dimension-{n}": n for n in DIMENSIONS} | {MAIN: RECIPE.dimension}
    rows = [
        (str(dimension), *_precisions(results, name))
        for name, dimension in sorted(names.items(), key=lambda item: -item[1])
        if name in results.found
    ]
    most, fewer = (f"dimension-{n}" for n in DIMENSIONS)
    if most in results.found and fewer in results.found:
        of_each = [[results.precisions([n], on.name) for n in (fewer, most)] for on in results.sets]
        losses = [percent(relative(*both)[0]) for both in of_each]
        rows.append((f"{DIMENSIONS[1]} over {DIMENSIONS[0]}", *losses))
    return markdown(("values", *(each.name for each in results.sets)), rows)


def _dimension_series(results: Results) -> dict[str, dict[int, list[float]]]:
    names = {n: [f"dimension-{n}"] for n in DIMENSIONS}
    names[RECIPE.dimension] = results.seeds(MAIN_TRUNK, "multi-constraint")
    series = {}
    for each in results.sets:
        values = {n: results.precisions(names[n], each.name) for n in sorted(names)}
        series[each.name] = {n: measured for n, measured in values.items() if measured}
    return {name: by_dimension for name, by_dimension in series.items() if by_dimension}


def _budget_table(runs: Path) -> str:
    rows = []
    for planned in planned_trainings():
        log = read_log(planned.folder(runs) / LOG_NAME)
        if planned.is_start or not log:
            continue
        size = "{}x{}".format(*planned.plan.size or ("", ""))
        minutes = log[-1].elapsed_s / 60
        cut = planned.plan.block or "whole"
        rows.append((planned.name, cut, size, str(log[-1].step), f"{minutes:.1f}"))
    return markdown(("training", "trunk up to", "pixels", "steps", "minutes"), rows, names=3)


def _precisions(results: Results, name: str) -> list[str]:
    return [spread(results.precisions([name], each.name)) for each in results.sets]
