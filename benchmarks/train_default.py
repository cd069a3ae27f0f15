# SPDX-License-Identifier: Apache-2.0
"""Trains and calibrates the weights that are shipped: placerec/weights/default.safetensors.

    python benchmarks/train_default.py WORK --ie-tower FOLDER --mobilenet mobilenet_v2.npz [--ship]

Renders the scenes, trains in two stages, small images first, and calibrates on floors that were
not trained on: about an hour and a half on two cores. What is done already is not done again.
With --ship the result replaces the shipped weights.

With --loss triplet it trains the default's twin, placerec/weights/triplet.safetensors: all the same
but for the loss, for the paper's main comparison.
"""

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

from placerec.baselines.triplet import TRIPLET_WEIGHTS
from placerec.embedding import DEFAULT_WEIGHTS
from placerec.training_run import WEIGHTS_NAME

ROOT = Path(__file__).parents[1]
SCENES = ("--rooms", "90", "--desks", "100", "--seed", "1000")
NETWORK = ("--block", "block12", "--covariance", "--dimension", "512")
LEARNING = (
    *("--alpha", "1", "--beta", "0.6", "--gamma-prime", "1.3"),
    *("--scenes-per-round", "3", "--places-per-scene", "12", "--images-per-place", "4"),
    *("--batch-sets", "40", "--learning-rate", "1e-3", "--mixed-precision"),
)
STAGES = (
    ("--size", "160", "120", "--trunk-learning-rate", "1.5e-4", "--steps", "1800", "--seed", "0"),
    ("--size", "224", "168", "--trunk-learning-rate", "1e-4", "--steps", "800", "--seed", "1"),
)
"""The second starts from the first one's trunk, its fully connected layer again from whitening."""
SHIPPED = {"multi-constraint": DEFAULT_WEIGHTS, "triplet": TRIPLET_WEIGHTS}
FIRST_STAGE_SCENES = (50, 60)
"""Rooms and desks that the first stage learns from; the second takes all."""


def main() -> int:
    """Do what is not done yet."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("work", type=Path, help="folder for scenes and trainings")
    parser.add_argument("--ie-tower", type=Path, required=True)
    parser.add_argument("--mobilenet", type=Path, required=True, help="its ImageNet weights")
    parser.add_argument("--loss", choices=SHIPPED, default="multi-constraint")
    parser.add_argument("--ship", action="store_true")
    options = parser.parse_args()
    scenes, weights = options.work / "scenes", options.mobilenet
    _run(ROOT / "benchmarks/training_scenes.py", scenes, "--photographs", options.ie_tower, *SCENES)
    for number, stage in enumerate(STAGES, start=1):
        folder = options.work / f"{options.loss}-stage{number}"
        if not (folder / WEIGHTS_NAME).exists():
            images = [*_scenes(scenes, FIRST_STAGE_SCENES if number == 1 else None)]
            out = ("--out", folder, "--weights", weights, "--loss", options.loss)
            images.append(options.ie_tower)
            _run("-m", "placerec.cli", "train", *images, *out, *NETWORK, *LEARNING, *stage)
        weights = folder / WEIGHTS_NAME
    if options.ship:
        weights = Path(shutil.copy(weights, SHIPPED[options.loss]))
    validation = f"{options.ie_tower}:validation"
    _run("-m", "placerec.cli", "calibrate", validation, "--recognizer", weights)
    return 0


def _scenes(folder: Path, counts: tuple[int, int] | None) -> list[Path]:
    """Return the folders of the first so many rooms and desks, or of all."""
    rooms, desks = (sorted(folder.glob(f"{kind}*")) for kind in ("room", "desk"))
    return [*desks, *rooms] if counts is None else [*desks[: counts[1]], *rooms[: counts[0]]]


def _run(*arguments: str | Path) -> None:
    subprocess.run([sys.executable, *map(str, arguments)], check=True, cwd=ROOT)


if __name__ == "__main__":
    sys.exit(main())
