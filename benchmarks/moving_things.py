# SPDX-License-Identifier: Apache-2.0
"""Whether the camera follows something that moves before it, and whether that is said.

    python benchmarks/moving_things.py [SEQUENCE] [--frames 60]

A board of random colours is painted over the images of a recording with true poses, 70 cm before
the camera, and moves across them. Prints a Markdown table: the share of the image that it covers,
how far it moves from frame to frame, in which frame it appears, the ATE of the path in the end, and
whether the run warns of it.
"""

import argparse
from collections.abc import Iterator
from itertools import islice

from tqdm import tqdm

from placerec.recognizer import load
from slam import Frame, Slam, open_sequence
from slam.config import EvaluationConfig, InputConfig
from slam.datasets import Sequence, resolve
from slam.evaluation.drift import trajectory_error
from slam.evaluation.stress.moving_board import board, covered

# Width and height as shares of the image, pixels from frame to frame, and the frame it appears in.
_BOARDS = (
    (0.0, 0.0, 0, 0),
    (0.125, 0.4, 10, 0),
    (0.1875, 0.5, 10, 0),
    (0.25, 1.0, 3, 0),
    (0.25, 1.0, 8, 0),
    (0.25, 1.0, 20, 0),
    (0.25, 1.0, 12, 20),
    (0.5, 1.0, 10, 0),
)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("sequence", nargs="?", default="fr1_xyz")
    parser.add_argument("--frames", type=int, default=60)
    arguments = parser.parse_args()
    sequence = open_sequence(resolve(arguments.sequence), InputConfig())
    print("| of the image | pixels a frame | from frame | ATE | warned |")
    print("|---|---|---|---|---|")
    for each in tqdm(_BOARDS, leave=False):
        tqdm.write(_row(sequence, arguments.frames, *each))


def _row(
    sequence: Sequence, count: int, width: float, height: float, step_px: int, first: int
) -> str:
    slam = Slam(sequence.camera, load("gradients"))
    size = round(width * sequence.camera.width), round(height * sequence.camera.height)
    for frame in _covered(islice(sequence, count), size, step_px, first):
        slam.process(frame)
    result = slam.finish()
    assert sequence.ground_truth is not None
    drift = trajectory_error(result.trajectory, sequence.ground_truth, EvaluationConfig())
    warned = "yes" if any("something moves" in each for each in result.warnings) else "no"
    cells = (f"{width * height:.0%}", step_px, first, f"{drift.ate_rmse_m:.4f} m", warned)
    return f"| {' | '.join(map(str, cells))} |"


def _covered(
    frames: Iterator[Frame], size: tuple[int, int], step_px: int, first: int
) -> Iterator[Frame]:
    image = board(*size)
    for number, frame in enumerate(frames):
        yield frame if number < first else covered(frame, image, (number - first) * step_px)


if __name__ == "__main__":
    main()
