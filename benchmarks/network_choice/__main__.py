# SPDX-License-Identifier: Apache-2.0
"""Compares networks on validation images and prints a table, the best first.

    python -m benchmarks.network_choice --data DATA --validation PATHS \
        --scenes SCENES --trunk-weights WEIGHTS [--only "block12 at 224"]
    python -m benchmarks.network_choice --data DATA --validation PATHS --trained FILE...

Untrained ones, or those that trainings left in weights files.

From the root of the repository. DATA holds ie_tower and rgbd_dataset_freiburg1_xyz; nothing else of
it is opened. SCENES and PATHS are made by `python -m benchmarks.training_scenes`, and so are paths
around what fr1_xyz recorded, for --views, which are measured on but do not count. All candidates
take about two hours on one thread.
"""

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from numpy.typing import NDArray
from tqdm import tqdm

from benchmarks.network_choice.candidates import build, candidates, embed, megabytes
from benchmarks.network_choice.domains import all_images, judge, open_domains, overall
from placerec.datasets import open_dataset
from placerec.datasets.images import BrokenImage, images_in, read_image
from placerec.errors import RecognizerError
from placerec.networks import PlaceNetwork
from placerec.networks.weights_file import load_weights

IMAGES_OF_A_KIND = 1000
TIMED = 30


def main() -> None:
    """Do what the command line asks for."""
    arguments = _arguments()
    torch.set_num_threads(1)
    domains = open_domains(arguments.data, arguments.validation, arguments.views)
    rows: list[tuple[str, dict[str, float], float, float]] = []
    for name, network in _trained(arguments) if arguments.trained else _untrained(arguments):
        scores = judge(domains, embed(network, all_images(domains)))
        rows.append((name, scores, _milliseconds(network), megabytes(network)))
    rows.sort(key=lambda row: -overall(row[1]))
    names = [*domains, "all", "without xyz", "ms", "MB"]
    print(f"| network | {' | '.join(names)} |\n| --- |{' ---: |' * len(names)}")
    for name, scores, ms, size_mb in rows:
        shown = [*scores.values(), overall(scores), overall(scores, without="xyz")]
        cells = [*(f"{value:.3f}" for value in shown), f"{ms:.1f}", f"{size_mb:.1f}"]
        print(f"| {name} | {' | '.join(cells)} |")


def _trained(arguments: argparse.Namespace) -> Iterator[tuple[str, PlaceNetwork]]:
    for path in tqdm(arguments.trained, unit="file"):
        yield str(path), load_weights(path)[0]


def _untrained(arguments: argparse.Namespace) -> Iterator[tuple[str, PlaceNetwork]]:
    fitted_on = _images_to_fit(arguments.data, arguments.scenes)
    chosen = [each for each in candidates() if arguments.only in str(each)]
    for candidate in tqdm(chosen, unit="candidate"):
        yield str(candidate), build(candidate, arguments.trunk_weights, fitted_on)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name in ("data", "validation"):
        parser.add_argument(f"--{name}", type=Path, required=True)
    for name in ("scenes", "trunk-weights"):
        parser.add_argument(f"--{name}", type=Path, help="for untrained networks")
    parser.add_argument("--views", type=Path, help="folder of paths around fr1_xyz; shown only")
    parser.add_argument("--only", default="", help="candidates whose name has this in it")
    parser.add_argument("--trained", type=Path, nargs="+", metavar="FILE", help="weights files")
    arguments = parser.parse_args()
    if not arguments.trained and not (arguments.scenes and arguments.trunk_weights):
        parser.error("give --scenes and --trunk-weights, or --trained")
    return arguments


def _images_to_fit(data: Path, scenes: Path) -> list[NDArray[np.uint8]]:
    """Return as many images of the training floors as of the rendered scenes, evenly spread."""
    floors = open_dataset(str(data / "ie_tower"), "train")
    rendered = [path for folder in sorted(scenes.iterdir()) for path in images_in(folder / "rgb")]
    of_floors = [floors[i] for i in _evenly(len(floors))]
    return of_floors + [_read(rendered[i]) for i in _evenly(len(rendered))]


def _evenly(count: int) -> Sequence[int]:
    chosen = np.linspace(0, count - 1, min(count, IMAGES_OF_A_KIND))
    return [int(i) for i in chosen]


def _read(path: Path) -> NDArray[np.uint8]:
    image = read_image(path)
    if isinstance(image, BrokenImage):
        raise RecognizerError(f"image cannot be read: {image.why}: {image.path}")
    return image


def _milliseconds(network: PlaceNetwork) -> float:
    """Return the median time of one image, made smaller and embedded on one thread."""
    image = np.random.default_rng(0).integers(0, 256, (480, 640, 3), np.uint8)
    seconds = []
    for _ in range(TIMED):
        start = perf_counter()
        embed(network, [image])
        seconds.append(perf_counter() - start)
    return 1e3 * float(np.median(seconds))


if __name__ == "__main__":
    main()
