# SPDX-License-Identifier: Apache-2.0
"""A made-up run: a camera going round a room more than once, with drift and loop attempts."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import pytest

from placerec.certificate import Certificate, Kind, Reached
from slam.evaluation.drift import DriftReport, TrajectoryError
from slam.evaluation.motion_truth import LoopTruth
from slam.result import Calibration, SlamResult
from slam.types import (
    Camera,
    FloatArray,
    Frame,
    Keyframe,
    LoopAttempt,
    Rejection,
    RejectionReason,
    RelativePose,
    Trajectory,
    Verification,
)

CAMERA = Camera(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)
PER_KEYFRAME = 5
REJECTIONS = (
    Rejection(RejectionReason.LOW_SIMILARITY, 0.71, 0.75),
    Rejection(RejectionReason.FEW_MATCHES, 12, 20),
    Rejection(RejectionReason.NO_POSE, 0, 25),
    Rejection(RejectionReason.FEW_INLIERS, 19, 25),
    Rejection(RejectionReason.LOW_INLIER_RATIO, 0.18, 0.25),
    Rejection(RejectionReason.NARROW_SUPPORT, 0.012, 0.04),
)


class Run(NamedTuple):
    result: SlamResult
    drift: DriftReport
    truth: Trajectory


def circle(times_s: FloatArray) -> FloatArray:
    """Return (N, 4, 4) poses on a circle of 1.5 m, once round in 10 s."""
    poses = np.tile(np.eye(4), (len(times_s), 1, 1))
    angle = 2 * np.pi * times_s / 10
    positions = (1.5 * np.cos(angle), 1.2 * np.sin(angle), 0.1 * np.sin(3 * angle))
    poses[:, :3, 3] = np.stack(positions, axis=1)
    return poses


def preview(generator: np.random.Generator, timestamp_s: float) -> Frame:
    blocks = generator.integers(0, 255, (15, 20, 3), dtype=np.uint8)
    rgb = np.ascontiguousarray(blocks.repeat(16, axis=0).repeat(16, axis=1))
    return Frame(timestamp_s, rgb, np.ones((240, 320), np.float32))


def attempt(
    generator: np.random.Generator, number: int, query_id: int, match_id: int
) -> LoopAttempt:
    motion = RelativePose(np.eye(4), np.eye(6))
    refusal = REJECTIONS[number // 3 % len(REJECTIONS)]
    outcome = motion if number % 3 == 0 else refusal
    matches = generator.uniform((0, 0, 0, 0), (640, 480, 640, 480), (60, 4))
    verification = Verification(
        outcome, matches, np.arange(60) < 30 + number % 30, np.zeros((60, 3))
    )
    similarity = 0.76 + 0.2 * generator.random()
    weight = None
    if number % 30 == 9:
        weight, outcome = 0.02, Rejection(RejectionReason.OUTVOTED, 0.02, 0.5)
    elif outcome is motion:
        weight = 0.98
    elif refusal.reason is RejectionReason.LOW_SIMILARITY:
        return LoopAttempt(query_id, match_id, refusal.measured, None, refusal)
    return LoopAttempt(query_id, match_id, similarity, verification, outcome, weight)


def error(times_s: FloatArray, errors_m: FloatArray) -> TrajectoryError:
    rmse = float(np.sqrt(np.mean(errors_m**2)))
    return TrajectoryError(times_s, np.eye(4), errors_m, rmse, 0.5 * rmse, 0.4, 1.0)


def judge(loop: LoopAttempt) -> LoopTruth:
    if loop.weight is None:
        return LoopTruth(np.nan, np.nan, 0.8, 25.0, None)
    if loop.weight < 0.5:
        return LoopTruth(0.31, 0.7, 0.1, 4.0, None, 800.0)
    return LoopTruth(0.02, 0.7, 0.1, 4.0, False, 5.4)


def make_run(keyframes: int = 40, attempts: int = 60) -> Run:
    """Return a run with this many keyframes and loop attempts of every kind."""
    generator = np.random.default_rng(7)
    times = 0.1 * np.arange(keyframes * PER_KEYFRAME)
    true_poses = circle(times)
    odometry, without_loops, corrected = true_poses.copy(), true_poses.copy(), true_poses.copy()
    drifted_m = 0.01 * times[:, None] * np.array([1.0, -0.5, 0.2])
    odometry[:, :3, 3] += drifted_m
    without_loops[:, :3, 3] += 0.6 * drifted_m
    corrected[:, :3, 3] += generator.normal(0, 0.004, (len(times), 3))
    frames = tuple(
        Keyframe(
            number, float(time), odometry[number * PER_KEYFRAME], None, preview(generator, time)
        )
        for number, time in enumerate(times[::PER_KEYFRAME])
    )
    pairs = [(query, match) for query in range(keyframes) for match in range(query - 12)]
    chosen = sorted(generator.choice(len(pairs), attempts, replace=False)) if attempts else []
    loops = tuple(attempt(generator, n, *pairs[pair]) for n, pair in enumerate(chosen))
    points = corrected[::PER_KEYFRAME, :3, 3]
    apart = np.linalg.norm(points[:, None] - points[None], axis=2)
    similarities = np.exp(-apart).astype(np.float32)
    result = SlamResult(
        camera=CAMERA,
        keyframes=frames,
        T_world_kf=corrected[::PER_KEYFRAME],
        odometry=Trajectory(times, odometry),
        live=Trajectory(times, odometry),
        without_loops=Trajectory(times, without_loops),
        trajectory=Trajectory(times, corrected),
        links=(),
        attempts=loops,
        similarities=similarities,
        min_similarity=0.75,
        untracked_s=np.empty(0),
        stage_seconds={"read": 1.2, "track": 2.4, "describe": 0.6, "verify": 0.9, "optimise": 0.2},
        warnings=(),
        elapsed_s=4.0,
    )
    errors = (
        np.linalg.norm(poses[:, :3, 3] - true_poses[:, :3, 3], axis=1)
        for poses in (odometry, without_loops, corrected)
    )
    tracked, without, after = (error(times, one) for one in errors)
    drift = DriftReport(
        odometry=tracked,
        live=tracked,
        without_loops=without,
        corrected=after,
        smoothed=None,
        loops=tuple(map(judge, loops)),
        links_nees=np.array([4.0, 5.0, 6.0, np.nan]),
        tolerance_s=0.02,
        coverage=1.0,
        rpe_interval_s=1.0,
        truth_length_m=17.2,
        truth=Trajectory(times, true_poses),
    )
    return Run(result, drift, Trajectory(times, true_poses))


def make_calibration(result: SlamResult) -> Calibration:
    """Return a made-up certificate, beside the similarities of all pairs of keyframes."""
    floors = Kind(
        data="ie_tower:validation",
        images=288,
        skipped=3,
        pairs=26127,
        same_place_pairs=540,
        resampled="places",
        different_places=(-0.24, 0.75),
        same_place=(0.3, 0.95),
        threshold=0.87,
        left_out_to_verify=Reached(threshold=0.78, different_places=0.004, same_place=0.75),
        left_out_tau=Reached(threshold=0.85, different_places=0.003, same_place=0.25),
    )
    rooms = {"data": "rooms", "skipped": 0, "different_places": (-0.1, 0.78), "threshold": 0.85}
    certificate = Certificate(
        version=2,
        recognizer="tower.safetensors",
        fingerprint=f"sha256:{'0123456789abcdef' * 4}",
        kinds=(floors, floors.model_copy(update=rooms)),
        recall_to_verify=0.37,
        recall=0.12,
        min_similarity_interval=(0.7, 0.8),
        threshold_interval=(0.62, 0.89),
        recall_interval=(0.05, 0.16),
        resamples=1000,
        seed=0,
        curve=((0.87, 0.001, 0.12), (0.3, 0.5, 1.0)),
    )
    rows, columns = np.triu_indices(len(result.keyframes), k=5)
    return Calibration(certificate, result.similarities[rows, columns])


@pytest.fixture(scope="session")
def run() -> Run:
    return make_run()


@pytest.fixture(scope="session")
def make() -> Callable[..., Run]:
    return make_run


@pytest.fixture(scope="session")
def certified(run: Run) -> Run:
    """Return the run as with a recognizer that has a certificate."""
    return run._replace(result=replace(run.result, calibration=make_calibration(run.result)))


@pytest.fixture
def altered(run: Run) -> Callable[..., SlamResult]:
    """Return the run's result with some fields replaced."""
    return lambda **fields: replace(run.result, **fields)
