# SPDX-License-Identifier: Apache-2.0
"""Trains and calibrates the weights that are shipped: placerec/weights/default.safetensors.

    python benchmarks/train_default.py WORK --ie-tower FOLDER --mobilenet mobilenet_v2.npz [--ship]

Renders the scenes, trains on small images and then twice on larger ones, with all scenes as they
come and with photographs drawn nine times as often, averages the two trunks, whitens what that
makes of both kinds, and calibrates on four kinds of scenes that were not trained on: two hours
on two cores. One of the kinds is fr1_xyz, which has to lie in $LOOPCLOSE_DATA. What is done already
is not done again. With --ship the result replaces the weights that are in the repository.

With --loss triplet it trains the default's twin, benchmarks/weights/triplet.safetensors: all the
same but for the loss, for the paper's main comparison.
"""

import argparse
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import torch

from placerec.networks.weights_file import load_weights, save_weights
from placerec.recognizers.learned import DEFAULT_WEIGHTS
from placerec.training.run import WEIGHTS_NAME

ROOT = Path(__file__).parents[1]
TRIPLET_WEIGHTS = ROOT / "benchmarks" / "weights" / "triplet.safetensors"
SCENES = ("--rooms", "90", "--desks", "100", "--seed", "1000")
CALIBRATION = {
    "rooms": ("--rooms", "3", "--desks", "0"),
    "tables": ("--rooms", "0", "--desks", "3"),
}
NETWORK = ("--block", "block12", "--covariance")
LEARNING = (
    *("--alpha", "1", "--beta", "0.6", "--gamma-prime", "1.3"),
    *("--scenes-per-round", "3", "--places-per-scene", "12", "--images-per-place", "4"),
    *("--batch-sets", "40", "--learning-rate", "1e-3", "--mixed-precision", "--dimension", "512"),
)
SMALL = ("--size", "160", "120", "--trunk-learning-rate", "1.5e-4", "--steps", "1800")
LARGE = ("--size", "224", "168", "--trunk-learning-rate", "1e-4", "--steps", "800")
LAST = ("--size", "224", "168", "--steps", "0", "--dimension", "1000")
"""No step: the fully connected layer is made of whitened principal components, anew each time."""
SHIPPED = {"multi-constraint": DEFAULT_WEIGHTS, "triplet": TRIPLET_WEIGHTS}


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
    scenes = options.work / "scenes"
    photographs = ("--photographs", options.ie_tower)
    _run("-m", "benchmarks.training_scenes", scenes, *photographs, *SCENES)
    rooms, desks = (sorted(scenes.glob(f"{kind}*")) for kind in ("room", "desk"))
    few = _together(options.work / "few", [*desks[:60], *rooms[:50], options.ie_tower])
    all_ = _together(options.work / "all", [*desks, *rooms, options.ie_tower])
    alike = (scenes, options.ie_tower)

    def train(name: str, start: Path, *how: str | Path) -> Path:
        folder: Path = options.work / f"{options.loss}-{name}"
        if not (folder / WEIGHTS_NAME).exists():
            out = ("--out", folder, "--weights", start, "--loss", options.loss)
            _run("-m", "placerec", "train", *how, *out, *NETWORK)
        return folder / WEIGHTS_NAME

    small = train("small", options.mobilenet, few, *LEARNING, *SMALL, "--seed", "0")
    first = train("as-they-come", small, all_, *LEARNING, *LARGE, "--seed", "1")
    second = train("more-photographs", small, *alike, *LEARNING, *LARGE, "--seed", "2")
    average = _average([first, second], options.work / f"{options.loss}-average.safetensors")
    weights = train("last", average, *alike, *LAST)
    if options.ship:
        weights = Path(shutil.copy(weights, SHIPPED[options.loss]))
    validation = f"{options.ie_tower}:validation"
    rendered = [options.work / "calibration" / kind for kind in CALIBRATION]
    for folder in rendered:
        how = (*CALIBRATION[folder.name], "--paths", "--seed", "5000", "--photographs", validation)
        _run("-m", "benchmarks.training_scenes", folder, *how)
    kinds = (validation, "fr1_xyz", *rendered)
    _run("-m", "placerec", "calibrate", *kinds, "--recognizer", weights)
    if weights == DEFAULT_WEIGHTS:
        _run("-m", "benchmarks.default_graph")
    return 0


def _together(folder: Path, recordings: Sequence[Path]) -> Path:
    """Return a folder of links to recordings, in this order: one collection for a training."""
    folder.mkdir(exist_ok=True)
    for number, recording in enumerate(recordings):
        link = folder / f"{number:03}"
        if not link.exists():
            link.symlink_to(recording.resolve(), target_is_directory=True)
    return folder


def _average(trainings: Sequence[Path], out: Path) -> Path:
    """Write the mean of the trunks of trainings that had one start, and return its file."""
    networks = [load_weights(path)[0] for path in trainings]
    states = [network.features.state_dict() for network in networks]
    mean = {name: torch.stack([state[name] for state in states]).mean(dim=0) for name in states[0]}
    networks[0].features.load_state_dict(mean)
    save_weights(networks[0], out, min_similarity=0.0)
    return out


def _run(*arguments: str | Path) -> None:
    subprocess.run([sys.executable, *map(str, arguments)], check=True, cwd=ROOT)


if __name__ == "__main__":
    sys.exit(main())
