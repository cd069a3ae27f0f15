# SPDX-License-Identifier: Apache-2.0
"""How wrong are measured motions, and does their information matrix know it?

    python benchmarks/motion_noise.py PATH_TO_SEQUENCE_WITH_TRUTH

Runs the pipeline, compares every link and loop with ground truth, and prints the error against the
predicted standard deviation. A calibrated information matrix has a median squared normalised error
of 5.35 (chi-square, 6 degrees of freedom). The floors in relative_pose.py come
from fr1_xyz.
"""

import sys

import numpy as np

from placerec.recognizer import load
from slam.cli import DEFAULT_RECOGNIZER
from slam.config import Config
from slam.datasets import open_sequence, resolve
from slam.evaluation.trajectory import nearest
from slam.geometry import se3
from slam.system import Slam
from slam.types import Link, RelativePose


def main(name: str) -> None:
    """Print the table for one sequence."""
    sequence = open_sequence(resolve(name), Config().input)
    assert sequence.ground_truth is not None, "this benchmark needs ground truth"
    slam = Slam(sequence.camera, load(DEFAULT_RECOGNIZER))
    for frame in sequence:
        slam.process(frame)
    result = slam.finish()
    loops = [
        Link(attempt.match_id, attempt.query_id, attempt.outcome)
        for attempt in result.attempts
        if isinstance(attempt.outcome, RelativePose)
    ]
    truth = sequence.ground_truth
    stamps_s = np.array([keyframe.timestamp_s for keyframe in result.keyframes])
    T_truth_kf = truth.T_world_cam[nearest(truth.timestamps_s, stamps_s)]
    print("| motions | count | error mm | error deg | squared normalised error: median, 90 % |")
    print("|---|---|---|---|---|")
    for title, links in (("links", result.links), ("loops", loops)):
        print(f"| {title} | {len(links)} | {_row(links, T_truth_kf)} |")


def _row(links: tuple[Link, ...] | list[Link], T_truth_kf: np.ndarray) -> str:
    errors, squares = [], []
    for link in links:
        T_true = se3.inverse(T_truth_kf[link.ref_id]) @ T_truth_kf[link.query_id]
        error = se3.log(se3.inverse(link.motion.T_ref_query) @ T_true)
        errors.append((np.linalg.norm(error[3:]) * 1e3, np.degrees(np.linalg.norm(error[:3]))))
        squares.append(error @ link.motion.information @ error)
    median_mm, median_deg = np.median(errors, axis=0)
    return (
        f"{median_mm:.1f} | {median_deg:.2f} |"
        f" {np.median(squares):.1f}, {np.percentile(squares, 90):.1f}"
    )


if __name__ == "__main__":
    main(sys.argv[1])
