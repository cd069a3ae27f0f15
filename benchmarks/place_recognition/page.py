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
from matplotlib.figure import Figure

from benchmarks.place_recognition.measured import (
    DEFAULT,
    GRADIENTS,
    EvaluationSet,
    Measured,
    Results,
    collect,
)
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
from placerec.checked_recognizer import Similarities
from placerec.datasets import PlaceDataset
from placerec.evaluation.embeddings import embed_dataset
from placerec.evaluation.figures import (
    bars,
    dimension_comparison,
    heat_maps,
    png,
    precision_recall,
    recognised_places,
    svg,
)
from placerec.evaluation.measurement import Cost, measure_cost
from placerec.evaluation.precision_recall import best_match_curve, best_matches, pair_curve
from placerec.files import write_atomically
from placerec.recognizer import PlaceRecognizer
from placerec.recognizers.gradients import GradientRecognizer
from placerec.recognizers.learned import LearnedRecognizer
from placerec.training.log import read_log
from placerec.training.loop import LOG_NAME

PAPERS_EXTRACTION_MS = {"AlexNet, per pair of images": 22.0}
PAPERS_COMPARISON_MS = {"4096 values": 0.0189}
PAPERS_BYTES = {"1000 values": 4.0 * 1000, "4096 values": 4.0 * 4096}
"""The paper's dimensions in single precision; its figures name no other numbers in the text."""


class Figures:
    """Draws figures into a folder; each method returns the files' names."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        folder.mkdir(parents=True, exist_ok=True)

    def curves(self, each: EvaluationSet, methods: Mapping[str, Measured]) -> list[str]:
        """Draw precision over recall of all pairs and of best matches (Figures 5 to 8)."""
        dataset = _typical(each, next(iter(methods.values())))
        found = {name: m.similarities[dataset.name] for name, m in methods.items()}
        title = each.name if len(each.datasets) == 1 else f"{each.name}: {dataset.name}"
        slug = each.name.replace(" ", "_")
        pairs = {name: pair_curve(values, dataset) for name, values in found.items()}
        best = {name: best_match_curve(values, dataset) for name, values in found.items()}
        return [
            self._write(f"pairs-{slug}.png", precision_recall(pairs, f"{title}, all pairs")),
            self._write(f"best-{slug}.png", precision_recall(best, f"{title}, best matches")),
        ]

    def distances(self, dataset: PlaceDataset, methods: Mapping[str, Similarities]) -> str:
        """Draw distances beside the truth (Figure 11)."""
        return self._write(f"distances-{dataset.name}.png", heat_maps(dataset, methods, columns=2))

    def dimensions(self, series: Mapping[str, Mapping[int, list[float]]]) -> str:
        """Draw average precision over the dimension (Figure 12)."""
        return self._write("dimensions.svg", dimension_comparison(series))

    def costs(self, costs: Mapping[str, Cost]) -> list[str]:
        """Draw what embedding, comparing and keeping take (Figures 13 to 15)."""
        embed = {name: cost.embed_ms for name, cost in costs.items()}
        compare = {name: cost.compare_ms for name, cost in costs.items()}
        size = {name: float(cost.embedding_bytes) for name, cost in costs.items()}
        return [
            self._write("extraction.svg", bars(embed, "ms per image", PAPERS_EXTRACTION_MS)),
            self._write("comparison.svg", bars(compare, "ms per comparison", PAPERS_COMPARISON_MS)),
            self._write("sizes.svg", bars(size, "bytes per image", PAPERS_BYTES)),
        ]

    def way(self, name: str, dataset: PlaceDataset, similarities: Similarities) -> str:
        """Draw the recognised places on the way (Figure 9), at the threshold of most recall."""
        curve = best_match_curve(similarities, dataset)
        matches = best_matches(similarities, dataset)
        figure = recognised_places(dataset, matches, curve.balanced_threshold, name)
        return self._write(f"way-{name.replace(' ', '_')}.svg", figure)

    def _write(self, name: str, figure: Figure) -> str:
        save = svg if name.endswith(".svg") else png
        write_atomically(self._folder / name, save(figure))
        return name


def _typical(each: EvaluationSet, method: Measured) -> PlaceDataset:
    """Return the dataset that stands for a set of several, whose curves cannot be averaged.

    On it the method's average precision is nearest to its mean over all.
    """

    def off(dataset: PlaceDataset) -> float:
        own = pair_curve(method.similarities[dataset.name], dataset).area
        return abs(own - method.scores[each.name].average_precision)

    return min(each.datasets, key=off)


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
