# SPDX-License-Identifier: Apache-2.0
"""Trains what is compared, measures it, and writes docs/place_recognition.md with its figures.

    python -m benchmarks.place_recognition --data DATA --scenes SCENES --validation PATHS \
        --trunk-weights WEIGHTS --runs runs/page [--part 1/2 | --only-page | --list]

From the root of the repository. SCENES and PATHS are made by `python -m benchmarks.training_scenes`
(with --paths). A finished training is not repeated, an interrupted one resumes. With --part,
several processes share the trainings and no page is written; write it afterwards with --only-page.
"""

import argparse
from pathlib import Path

from benchmarks.place_recognition.trainings import planned_trainings, train
from placerec.recognizers.learned import DEFAULT_WEIGHTS

DOCS = Path(__file__).parents[2] / "docs"


def main() -> None:
    """Do what the command line asks for."""
    arguments = _arguments()
    part, parts = arguments.part or (1, 1)
    planned = planned_trainings()[part - 1 :: parts]
    if arguments.list:
        for each in planned:
            done = "done" if each.weights(arguments.runs).exists() else "to do"
            print(f"{done:5}  {each.folder(arguments.runs).name}")
        return
    data, weights, runs = arguments.data, arguments.trunk_weights, arguments.runs
    if not arguments.only_page:
        train(planned, data, arguments.scenes, weights, runs)
    if not arguments.part:
        # Loaded here: figures need libraries that a training does not.
        from benchmarks.place_recognition.page import write_page

        write_page(data, arguments.validation, weights, runs, arguments.default, DOCS)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    for name, what in (
        ("data", "folder of ie_tower, corridor, rgbd_dataset_freiburg1_desk and _xyz"),
        ("scenes", "folder of the rendered scenes to learn from"),
        ("validation", "folder of the rendered paths to measure on"),
        ("trunk-weights", "folder of the published weights"),
        ("runs", "folder for the trainings, and for what was measured"),
    ):
        parser.add_argument(f"--{name}", type=Path, required=True, help=what)
    parser.add_argument("--default", type=Path, default=DEFAULT_WEIGHTS, help="shipped weights")
    parser.add_argument("--only-page", action="store_true", help="train nothing")
    parser.add_argument("--list", action="store_true", help="print the trainings and what is done")
    parser.add_argument("--part", type=_part, metavar="K/N", help="train the K-th of N parts")
    return parser.parse_args()


def _part(text: str) -> tuple[int, int]:
    part, parts = (int(number) for number in text.split("/"))
    if not 1 <= part <= parts:
        raise ValueError
    return part, parts


if __name__ == "__main__":
    main()
