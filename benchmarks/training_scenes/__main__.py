# SPDX-License-Identifier: Apache-2.0
"""Makes scenes to learn places from: folders in TUM RGB-D's format, every view with its pose.

    python -m benchmarks.training_scenes OUT --photographs ie_tower [--rooms 60] [--desks 60]
    python -m benchmarks.training_scenes OUT --photographs ie_tower --recording FOLDER
    python -m benchmarks.training_scenes OUT --photographs ie_tower:validation --paths --seed 9000
    python -m benchmarks.training_scenes OUT --photographs ie_tower:validation --paths --depth

From the root of the repository. Rooms and cluttered tables are rendered; of a recording with depth
and true poses, as rgbd_dataset_freiburg1_xyz is one, views are made that its camera never had. With
--paths the camera is carried around instead, as in a recording, which is what to validate with;
with --depth it is a Kinect, and `run_slam` can track it; these need a folder of their own.
Scenes that are there are kept.
"""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from benchmarks.training_scenes.handheld import Image, write_folder
from benchmarks.training_scenes.recorded import RecordedPlace
from benchmarks.training_scenes.rendered import record_path, views
from placerec.datasets import open_dataset
from placerec.errors import LoopcloseError

PATHS_OF_A_RECORDING = 4


def main() -> int:
    """Make what is not there yet."""
    options = _arguments()
    try:
        images = open_dataset(options.photographs, "train")
        photographs = [images[i] for i in range(0, len(images), 3)]
        options.out.mkdir(parents=True, exist_ok=True)
        if options.recording:
            _look_anew(options, photographs)
        else:
            _render(options, photographs)
    except LoopcloseError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _look_anew(options: argparse.Namespace, photographs: Sequence[Image]) -> None:
    names = [f"view{n:03d}" for n in range(PATHS_OF_A_RECORDING if options.paths else 1)]
    if all((options.out / name).exists() for name in names):
        return
    place = RecordedPlace(options.recording)
    make = place.path if options.paths else place.views_of_places
    for n, name in enumerate(tqdm(names, desc="looking", unit="scene")):
        if not (options.out / name).exists():
            write_folder(options.out / name, make(photographs, options.seed + n))


def _render(options: argparse.Namespace, photographs: Sequence[Image]) -> None:
    for kind, count in (("room", options.rooms), ("desk", options.desks)):
        for n in tqdm(range(count), desc=f"{kind}s", unit="scene"):
            folder = options.out / f"{kind}{n:03d}"
            if not folder.exists():
                seed = options.seed + n
                if options.depth:
                    record_path(folder, kind, seed, photographs)
                else:
                    write_folder(folder, views(kind, seed, photographs, options.paths))


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--photographs", required=True, help="whose images are pasted on surfaces")
    parser.add_argument("--rooms", type=int, default=60)
    parser.add_argument("--desks", type=int, default=60)
    parser.add_argument("--recording", type=Path, help="look at it anew, instead of at those")
    parser.add_argument("--paths", action="store_true")
    parser.add_argument("--depth", action="store_true", help="of --paths, in 640x480 px")
    parser.add_argument("--seed", type=int, default=1000)
    options = parser.parse_args()
    if options.depth and (options.recording or not options.paths):
        parser.error("--depth is for rendered --paths")
    return options


if __name__ == "__main__":
    sys.exit(main())
