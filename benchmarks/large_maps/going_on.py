# SPDX-License-Identifier: Apache-2.0
"""Going on from a saved map: two recordings in one frame, and the second half placed in the first.

    python -m benchmarks.large_maps.going_on

fr1_xyz onto the map of fr1_desk, the reverse, and both in one run: the ATE of all keyframes in one
alignment. Both clips were filmed in one room, in front of one motion capture. Then the second half
of fr1_desk is placed live in the map of the first: a frame sees the first half where a keyframe of
it is within 0.5 m and 30 degrees, by the truth. Prints a Markdown table and a sentence.
"""

import argparse
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from placerec.recognizer import PlaceRecognizer, load
from slam import Config, Slam, SlamResult, TrackedFrame, Trajectory, load_map, save_map, saved_map
from slam.commands.opening import DEFAULT_RECOGNIZER
from slam.datasets import Sequence, open_sequence, resolve
from slam.evaluation.drift import trajectory_error
from slam.evaluation.trajectory import align, poses_at
from slam.geometry import se3
from slam.types import FloatArray, Frame

CLIPS = ("fr1_desk", "fr1_xyz")
TOLERANCE_S = Config().evaluation.max_time_difference_s
SEES_M, SEES_RAD, PLACED_M = 0.5, np.deg2rad(30.0), 0.03


@dataclass(frozen=True)
class Fed:
    """What a run said of its frames as it went: (N,) times and (N, 4, 4) T_map_cam, or NaN."""

    timestamps_s: FloatArray
    T_map_cam: FloatArray

    @property
    def is_placed(self) -> NDArray[np.bool_]:
        """Return (N,) whether a frame had a place in the map when it came."""
        return np.asarray(np.isfinite(self.T_map_cam[:, 0, 0]))


def feed(slam: Slam, clips: Iterable[Iterable[Frame]]) -> Fed:
    """Feed recordings one after the other, and wait until all keyframes are taken in."""
    stamps_s, poses = [], []
    for clip in clips:
        slam.start_session()
        for frame in tqdm(clip, desc="tracking", unit=" frames", mininterval=1.0):
            tracked = slam.process(frame)
            T_world_odom = slam.correction.T_world_odom
            T_map_cam = np.full((4, 4), np.nan)
            if isinstance(tracked, TrackedFrame) and tracked.segment in T_world_odom:
                T_map_cam = T_world_odom[tracked.segment] @ tracked.T_odom_cam
            stamps_s.append(frame.timestamp_s)
            poses.append(T_map_cam)
    slam.settle()
    return Fed(np.array(stamps_s), np.array(poses))


def keyframes_of(result: SlamResult) -> Trajectory:
    """Return where keyframes were put, of all recordings, in the order of time."""
    stamps_s = np.array([each.timestamp_s for each in result.keyframes])
    order = np.argsort(stamps_s)
    order = order[np.isfinite(result.T_world_kf[order, 0, 0])]
    return Trajectory(stamps_s[order], result.T_world_kf[order])


def row(name: str, result: SlamResult, truth: Trajectory, given: int, first_s: float) -> str:
    """Return a line of the table."""
    keyframes = keyframes_of(result)
    ate_mm = 1e3 * trajectory_error(keyframes, truth, Config().evaluation).ate_rmse_m
    return (
        f"| {name} | {len(keyframes)} of {len(result.keyframes)} | {ate_mm:.2f} "
        f"| {len(result.trajectory)} of {given} | {first_s:.2f} |"
    )


def first_placed_s(fed: Fed) -> float:
    """Return how long after the first frame the camera had a place in the map, NaN if never."""
    placed_s = fed.timestamps_s[fed.is_placed]
    return float(placed_s[0] - fed.timestamps_s[0]) if len(placed_s) else np.nan


def half_placed(first: SlamResult, fed: Fed, truth: Trajectory) -> str:
    """Return a sentence on the frames that see what the first half's map holds."""
    T_truth_kf = poses_at(truth, np.array([k.timestamp_s for k in first.keyframes]), TOLERANCE_S)
    known = np.isfinite(T_truth_kf[:, 0, 0]) & np.isfinite(first.T_world_kf[:, 0, 0])
    T_truth_map = align(first.T_world_kf[known, :3, 3], T_truth_kf[known, :3, 3])
    T_truth_cam = poses_at(truth, fed.timestamps_s, TOLERANCE_S)
    T_kf_cam = se3.inverse(T_truth_kf[known])[:, None] @ T_truth_cam
    turned_rad = np.linalg.norm(se3.log(T_kf_cam)[..., :3], axis=-1)
    away_m = np.linalg.norm(T_kf_cam[..., :3, 3], axis=-1)
    sees = ((away_m < SEES_M) & (turned_rad < SEES_RAD)).any(axis=0)
    off_m = np.linalg.norm((T_truth_map @ fed.T_map_cam - T_truth_cam)[:, :3, 3], axis=1)
    placed = int((sees & (off_m < PLACED_M)).sum())
    return (
        f"Of {sees.sum()} frames of the second half that see the first, {placed} "
        f"({100 * placed / sees.sum():.1f} %) were placed live within {1e3 * PLACED_M:.0f} mm."
    )


def measure(clips: dict[str, Sequence], recognizer: str, scratch: Path) -> Iterable[str]:
    """Yield the lines of the table, then the sentence."""
    model, camera = load(recognizer), clips[CLIPS[0]].camera
    truth = joined([clip.ground_truth for clip in clips.values() if clip.ground_truth is not None])
    yield "| run | keyframes placed | joint ATE, mm | frames placed | first placed after, s |"
    yield "|---|---|---|---|---|"
    both = Slam(camera, model)
    in_time = sorted(clips.values(), key=lambda clip: float(clip.timestamps_s[0]))
    fed = feed(both, in_time)
    yield row("both in one run", both.finish(), truth, len(fed.timestamps_s), first_placed_s(fed))
    for name in CLIPS:
        alone = Slam(camera, model)
        feed(alone, [clips[name]])
        save_map(scratch / name, saved_map(alone, alone.finish()))
    for first, then in (CLIPS, CLIPS[::-1]):
        slam = Slam(camera, model, earlier=load_map(scratch / first, model))
        fed = feed(slam, [clips[then]])
        result = slam.finish()
        yield row(f"{then} onto {first}", result, truth, len(fed.timestamps_s), first_placed_s(fed))
    yield from halves(clips[CLIPS[0]], lambda **how: Slam(camera, model, **how), model, scratch)


def halves(
    clip: Sequence, new: Callable[..., Slam], recognizer: PlaceRecognizer, scratch: Path
) -> Iterable[str]:
    """Yield the sentence on a clip's second half, placed in a map of its first."""
    middle, truth = len(clip) // 2, clip.ground_truth
    assert truth is not None
    slam = new()
    feed(slam, [islice(clip, middle)])
    first = slam.finish()
    save_map(scratch / "half", saved_map(slam, first))
    before = contents(scratch / "half")
    slam = new(earlier=load_map(scratch / "half", recognizer), is_fixed=True)
    fed = feed(slam, [islice(clip, middle, None)])
    slam.finish()
    is_same = "unchanged" if contents(scratch / "half") == before else "CHANGED"
    yield f"\n{half_placed(first, fed, truth)} The map's bytes are {is_same}."


def contents(folder: Path) -> dict[Path, bytes]:
    """Return the bytes of every file."""
    return {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def joined(truths: list[Trajectory]) -> Trajectory:
    """Return the poses of recordings that do not overlap in time, as one."""
    truths = sorted(truths, key=lambda each: float(each.timestamps_s[0]))
    return Trajectory(
        np.concatenate([each.timestamps_s for each in truths]),
        np.concatenate([each.T_world_cam for each in truths]),
    )


def main() -> int:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("--recognizer", default=DEFAULT_RECOGNIZER, help="as for run_slam")
    asked = parser.parse_args()
    clips = {name: open_sequence(resolve(name), Config().input) for name in CLIPS}
    with tempfile.TemporaryDirectory() as scratch:
        for line in measure(clips, asked.recognizer, Path(scratch)):
            print(line, flush=True)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
