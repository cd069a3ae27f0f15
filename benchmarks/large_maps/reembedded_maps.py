# SPDX-License-Identifier: Apache-2.0
"""What it costs in recall that `run_slam reembed` sees a map's small images instead of whole ones.

    python -m benchmarks.large_maps.reembedded_maps RECORDING ... [--recognizers learned netvlad]

Frames of recordings with true poses, some five a second, are embedded whole and as a map keeps
them: halved, as a JPEG, and then enlarged again. Whole ones are the queries, as in a run with
--load. Prints how alike the two of a frame are; which share of the pairs of one place (eq. 10)
reaches the recognizer's threshold; and which is more alike than all but one in 1,000 pairs of
different places, more than twice as far apart, where there are such. Whole images come first.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from placerec import load
from placerec.checked_recognizer import CheckedRecognizer
from placerec.datasets.pose_distance import SAME_PLACE
from slam import Config, open_sequence
from slam.evaluation.trajectory import poses_at
from slam.geometry import se3
from slam.geometry.keyframe_memory import KeyframeMemory, full_size
from slam.tracking.tracked_frame import preview
from slam.types import FloatArray, Frame

APART = 5  # frames; those that follow each other more closely are no pair
EVERY_S = 0.2


def frames_of(recording: Path) -> tuple[list[Frame], FloatArray]:
    """Return frames with known poses, and the (N, N) distances between these."""
    sequence = open_sequence(recording, Config().input)
    if sequence.ground_truth is None:
        sys.exit(f"there are no true poses: {recording}")
    frames: list[Frame] = []
    for frame in sequence:
        if not frames or frame.timestamp_s >= frames[-1].timestamp_s + EVERY_S:
            frames.append(frame)
    stamps_s = np.array([frame.timestamp_s for frame in frames])
    T_world_cam = poses_at(sequence.ground_truth, stamps_s, Config().input.max_time_difference_s)
    known = np.flatnonzero(np.isfinite(T_world_cam[:, 0, 0]))
    poses = T_world_cam[known]
    distances = np.array([[se3.pose_distance(a, b) for b in poses] for a in poses])
    return [frames[k] for k in known], distances


def main() -> int:
    """Measure, and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("recordings", nargs="+", type=Path)
    parser.add_argument("--recognizers", nargs="+", default=["learned"])
    asked = parser.parse_args()
    print("| recording | recognizer | alike | reach the threshold | recall at 1 in 1,000 |")
    print("|---|---|---|---|---|")
    for recording in asked.recordings:
        frames, distances = frames_of(recording)
        memory = KeyframeMemory(10**9, 5000.0)
        whole = [frame.rgb for frame in frames]
        kept = [memory.keep_image(preview(frame)).rgb for frame in frames]
        small = [full_size(k, (w.shape[0], w.shape[1])) for k, w in zip(kept, whole, strict=True)]
        before, after = np.triu_indices(len(frames), APART)
        is_same = distances[before, after] < SAME_PLACE
        is_other = distances[before, after] > 2.0 * SAME_PLACE
        for name in asked.recognizers:
            recognizer = CheckedRecognizer(load(name))
            queries = np.array([recognizer.embed(rgb) for rgb in whole])
            reach, recall, alike = [], [], 1.0
            for references in (queries, np.array([recognizer.embed(rgb) for rgb in small])):
                found = recognizer.comparer.compare(queries, references)
                alike = float(np.diag(found).mean())
                pairs = found[after, before]
                others = np.sort(pairs[is_other])[::-1]
                tau = others[len(others) // 1000] if len(others) else np.inf
                reach.append(float((pairs[is_same] >= recognizer.min_similarity).mean()))
                recall.append(float((pairs[is_same] > tau).mean()))
            columns = [reach, recall] if is_other.any() else [reach]
            told = [", ".join(f"{share:.3f}" for share in each) for each in columns]
            cells = [recording.resolve().name, name, f"{alike:.3f}", *told, ""]
            print("| " + " | ".join(cells[:5]) + " |", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
