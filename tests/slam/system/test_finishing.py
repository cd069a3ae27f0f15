# SPDX-License-Identifier: Apache-2.0
"""What fails in the end of a run costs what it would have told, and nothing else."""

import numpy as np
import pytest

from placerec.recognizers.gradients import GradientRecognizer
from slam.config import Config, MotionConfig
from slam.evaluation import steps
from slam.external_odometry.odometry import ExternalOdometry
from slam.loops.back_end import BackEnd
from slam.loops.loop_closure import LoopCloser
from slam.mapping.landmark_map import LandmarkMap
from slam.system import Slam
from slam.tracking.frame_log import FrameLog
from slam.tracking.odometry import RgbdOdometry

COUNT = 12
OF_BOTH = {
    "the last keyframe's adjustment": (RgbdOdometry, "settle"),
    "the solved pose graph": (BackEnd, "solve"),
    "the map's adjustment": (LandmarkMap, "copy"),
    "how alike the keyframes are": (LoopCloser, "similarities"),
    "the live trajectory": (ExternalOdometry, "poses_as_asked"),
    "the look for leaps": (steps, "_apart"),
}
WITHOUT_POSES = {"smoothing": (FrameLog, "breaks_s")}
WITH_POSES = {
    "what the given poses say": (BackEnd, "solve_images"),
    "the given odometry, corrected,": (ExternalOdometry, "corrected"),
}
IN_ORDER = [
    "the last keyframe's adjustment",
    "what the given poses say",
    "the solved pose graph",
    "the map's adjustment",
    "the given odometry, corrected,",
    "how alike the keyframes are",
    "the live trajectory",
    "smoothing",
    "the look for leaps",
]


def fed(frames, camera, T_odom_cam):
    slam = Slam(camera, GradientRecognizer(), Config(motion=MotionConfig(smooth=True)))
    for frame, T in zip(frames, T_odom_cam, strict=True):
        slam.process(frame, T)
    return slam


@pytest.fixture(scope="module")
def alone(frames, sequence):
    """Return a run that is to be finished, and its result where nothing fails."""
    slam = fed(frames[:COUNT], sequence.camera, COUNT * [None])
    return slam, slam.finish()


@pytest.fixture(scope="module")
def with_poses(frames, sequence, T_first_cam):
    slam = fed(frames[:COUNT], sequence.camera, T_first_cam[:COUNT])
    return slam, slam.finish()


def fail(*_):
    raise RuntimeError("of all things")


def told(names):
    return tuple(f"{name} is missing: RuntimeError: of all things" for name in names)


@pytest.mark.parametrize("what", [*OF_BOTH, *WITHOUT_POSES])
def test_one_part_that_fails_is_told_and_the_rest_is_there(what, alone, monkeypatch):
    slam, whole = alone
    monkeypatch.setattr(*(OF_BOTH | WITHOUT_POSES)[what], fail)
    result = slam.finish()
    assert result.missing == told([what]) and not whole.missing
    assert len(result.trajectory) == len(result.odometry) == len(result.unsmoothed) == COUNT
    assert len(result.live) == (0 if what == "the live trajectory" else COUNT)
    assert np.isnan(result.similarities).all() == (what == "how alike the keyframes are")
    assert bool(result.links) == (what != "the solved pose graph")
    is_adjusted = what not in ("the solved pose graph", "the map's adjustment")
    assert np.array_equal(result.T_world_kf, whole.T_world_kf) or not is_adjusted


@pytest.mark.parametrize("what", WITH_POSES)
def test_so_it_is_with_poses_from_elsewhere(what, with_poses, monkeypatch):
    slam, whole = with_poses
    monkeypatch.setattr(*WITH_POSES[what], fail)
    result = slam.finish()
    assert result.missing == told([what]) and not whole.missing
    assert len(result.trajectory) == COUNT and whole.given.fits
    assert (result.given is None) == (what == "the given odometry, corrected,")


@pytest.mark.parametrize("run", ["alone", "with_poses"])
def test_all_that_fails_is_told_in_the_order_of_finishing(run, request, monkeypatch):
    slam, _ = request.getfixturevalue(run)
    failing = OF_BOTH | (WITHOUT_POSES if run == "alone" else WITH_POSES)
    for place in failing.values():
        monkeypatch.setattr(*place, fail)
    result = slam.finish()
    assert result.missing == told(name for name in IN_ORDER if name in failing)
    assert len(result.trajectory) == COUNT and result.given is None
    again = monkeypatch.undo() or slam.finish()
    assert not again.missing
