# SPDX-License-Identifier: Apache-2.0
"""What many tests need: the recording that was rendered, read, and two views of made-up points."""

import os
import shutil
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import pytest

from placerec.compiled import load_compiled
from placerec.recognizers.gradients import GradientRecognizer
from slam.config import InputConfig
from slam.datasets import Sequence, open_sequence
from slam.evaluation.drift import DriftReport
from slam.geometry import se3
from slam.geometry.features import back_project
from slam.result import SlamResult
from slam.system import Slam
from slam.types import Camera, Features, FloatArray, Frame

SHARED_DATA = Path(__file__).parents[2] / "../shared/data"
SMALL_CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
OTHER_CAMERA = Camera(350, 260, 328.125, 328.125, 174.5, 129.5)


@pytest.fixture(autouse=True, scope="session")
def loops_loaded_once() -> Iterator[None]:
    """Load what is compiled for the first `Slam` alone, as where a process has one.

    Each looks through all memory of the process for what it can do without, which takes a while
    where everything is loaded that tests need.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("slam.system.slam.load_compiled", cache(load_compiled))
        yield


@pytest.fixture(scope="session")
def data() -> Path:
    """Return the folder of the real recordings; whoever asks skips what is not in it."""
    return Path(os.environ.get("LOOPCLOSE_DATA", SHARED_DATA))


@pytest.fixture(scope="session")
def sequence(recording: Path) -> Sequence:
    return open_sequence(recording, InputConfig())


@pytest.fixture(scope="session")
def frames(sequence: Sequence) -> list[Frame]:
    return list(sequence)


@pytest.fixture(scope="session")
def T_first_cam(sequence: Sequence) -> FloatArray:
    """Return (60, 4, 4), the true poses in the first camera's frame."""
    assert sequence.ground_truth is not None
    T_truth_cam = sequence.ground_truth.T_world_cam
    return se3.inverse(T_truth_cam[0]) @ T_truth_cam


@pytest.fixture(scope="session")
def assert_no_correction_hurts() -> Callable[..., None]:
    """Return a check that what came later is no worse than what came before: 2 % or 0.2 mm."""

    def check(drift: DriftReport, most_m: float = 2e-4) -> None:
        assert drift.live is not None
        steps = (
            (drift.odometry, drift.live),
            (drift.odometry, drift.without_loops),
            (drift.without_loops, drift.corrected),
        )
        for before, after in steps:
            assert after.ate_rmse_m <= max(1.02 * before.ate_rmse_m, before.ate_rmse_m + most_m)

    return check


@pytest.fixture(scope="session")
def finished(frames: list[Frame]) -> tuple[Slam, SlamResult]:
    """Return the pipeline, with its default settings, after the whole recording; and its result."""
    slam = Slam(SMALL_CAMERA, GradientRecognizer())
    for frame in frames:
        slam.process(frame)
    return slam, slam.finish()


@pytest.fixture(scope="session")
def room_run(finished: tuple[Slam, SlamResult]) -> SlamResult:
    return finished[1]


@pytest.fixture
def short_recording(recording: Path, tmp_path: Path) -> Callable[..., Path]:
    """Copy the first frames of the recording to a folder that a test may spoil."""

    def copy(count: int = 12, name: str = "short") -> Path:
        folder = tmp_path / name
        for kind in ("rgb", "depth"):
            (folder / kind).mkdir(parents=True)
            lines = (recording / f"{kind}.txt").read_text().splitlines()[:count]
            (folder / f"{kind}.txt").write_text("\n".join(lines) + "\n")
            for line in lines:
                shutil.copy(recording / line.split()[1], folder / kind)
        for each in ("groundtruth.txt", "camera.toml"):
            shutil.copy(recording / each, folder)
        return folder

    return copy


@pytest.fixture(scope="session")
def by_another_camera() -> Callable[[Frame], Frame]:
    """Return what shows a frame of the small camera as `OTHER_CAMERA` sees it: cut and enlarged."""

    def seen(frame: Frame) -> Frame:
        rgb, depth_m = (each[16:224, 20:300] for each in (frame.rgb, frame.depth_m))
        size = (OTHER_CAMERA.width, OTHER_CAMERA.height)
        rgb = cv2.resize(rgb, size, interpolation=cv2.INTER_LINEAR).astype(np.uint8)
        nearest = cv2.resize(depth_m, size, interpolation=cv2.INTER_NEAREST)
        return Frame(frame.timestamp_s, rgb, nearest.astype(np.float32))

    return seen


class Views(NamedTuple):
    """Two views of the same points, and the motion between them."""

    reference: Features
    query: Features
    T_ref_query: FloatArray
    camera: Camera


@pytest.fixture(scope="session")
def make_views() -> Callable[..., Views]:
    """Return a maker of two views of random points with matching random descriptors."""
    return two_views


def two_views(
    T_ref_query: FloatArray,
    count: int = 150,
    *,
    outliers: int = 0,
    noise: float = 0.0,
    window_px: tuple[float, float] = (600.0, 440.0),
    seed: int = 0,
) -> Views:
    """Place points in a window of the reference's image, 1 to 3 m away, and look at them twice.

    Args:
        T_ref_query: the true motion, small enough for the query to see the points.
        count: points that agree with the motion.
        outliers: points whose descriptors match but which the query sees anywhere.
        noise: standard deviation, pixels, of all pixels; disparities get half of it.
        window_px: width and height of the window in the middle of the reference's image.
        seed: of everything random.
    """
    camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
    rng = np.random.default_rng(seed)
    total = count + outliers
    centre = np.array([camera.cx, camera.cy])
    reference_px = centre + rng.uniform(-0.5, 0.5, (total, 2)) * window_px
    reference_m = rng.uniform(1.0, 3.0, total)
    points_m = se3.transform(
        se3.inverse(T_ref_query), back_project(reference_px, reference_m, camera)
    )
    query_m = points_m[:, 2].copy()
    query_px = camera.fx * points_m[:, :2] / points_m[:, 2:] + centre
    query_px[count:] = rng.uniform((20.0, 20.0), (620.0, 460.0), (outliers, 2))
    query_m[count:] = rng.uniform(1.0, 3.0, outliers)
    descriptors = rng.integers(0, 256, (total, 32), dtype=np.uint8)
    shuffled = rng.permutation(total)
    return Views(
        _features(reference_px, reference_m, descriptors, noise, rng, camera),
        _features(query_px[shuffled], query_m[shuffled], descriptors[shuffled], noise, rng, camera),
        T_ref_query,
        camera,
    )


def _features(
    pixels: FloatArray,
    depth_m: FloatArray,
    descriptors: np.ndarray,
    noise: float,
    rng: np.random.Generator,
    camera: Camera,
) -> Features:
    baseline_fx = 0.075 * camera.fx
    pixels = pixels + noise * rng.standard_normal(pixels.shape)
    disparity_px = baseline_fx / depth_m + 0.5 * noise * rng.standard_normal(len(depth_m))
    depth_m = baseline_fx / disparity_px
    return Features(
        pixels=pixels,
        undistorted_px=pixels,
        octaves=np.zeros(len(pixels), dtype=np.int64),
        descriptors=descriptors,
        depth_m=depth_m,
        points_m=back_project(pixels, depth_m, camera),
    )


class Scene(NamedTuple):
    """Points in space, cameras that see all of them, and what each camera sees of them."""

    points_m: FloatArray
    T_world_cam: FloatArray
    features: list[Features]
    camera: Camera


@pytest.fixture(scope="session")
def make_scene() -> Callable[..., Scene]:
    """Return a maker of scenes; feature i of every camera shows point i."""
    return scene


def scene(cameras: int = 5, count: int = 120, noise: float = 0.0, seed: int = 0) -> Scene:
    """Look at points 2 to 3 m away from cameras in a row, 8 cm and 2 degrees apart."""
    camera = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
    rng = np.random.default_rng(seed)
    points_m = rng.uniform((-0.6, -0.6, 2.0), (0.6, 0.6, 3.0), (count, 3))
    descriptors = rng.integers(0, 256, (count, 32), dtype=np.uint8)
    steps = [np.array([0.0, -0.035 * i, 0.0, 0.08 * i, 0.01 * i, 0.0]) for i in range(cameras)]
    T_world_cam = np.array([se3.exp(step) for step in steps])
    features = []
    for T in T_world_cam:
        seen_m = se3.transform(se3.inverse(T), points_m)
        pixels = camera.fx * seen_m[:, :2] / seen_m[:, 2:] + np.array([camera.cx, camera.cy])
        features.append(_features(pixels, seen_m[:, 2].copy(), descriptors, noise, rng, camera))
    return Scene(points_m, T_world_cam, features, camera)
