# SPDX-License-Identifier: Apache-2.0
import cv2
import numpy as np
import pytest

from slam.config import FeaturesConfig, InputConfig, VerificationConfig
from slam.datasets import open_sequence
from slam.demo.recording import FRAMES_PER_S, LAP_S, drive, render_sequence
from slam.geometry import se3
from slam.geometry.features import FeatureExtractor, grey_of
from slam.geometry.relative_pose import estimate_relative_pose
from slam.types import Camera, RelativePose, SlamError

pytestmark = pytest.mark.usefixtures("built_rooms")

SMALL = Camera(160, 120, 131.25, 131.25, 79.5, 59.5)
FRAMES_PER_LAP = round(LAP_S * FRAMES_PER_S)


def render_small(folder, seed=0, progress=None):
    render_sequence(folder, seconds=0.2, seed=seed, progress=progress, camera=SMALL)
    return folder


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


@pytest.fixture(scope="module")
def rendered(tmp_path_factory):
    return render_small(tmp_path_factory.mktemp("demo") / "sequence")


def test_the_folder_is_a_tum_sequence_with_truth_and_camera(rendered):
    sequence = open_sequence(rendered, InputConfig())
    assert sequence.camera == SMALL
    assert sequence.warnings == () and sequence.skipped == []
    frames = list(sequence)
    assert np.allclose(
        [frame.timestamp_s for frame in frames], 100.0 + np.arange(3) / 15, atol=1e-6
    )
    assert np.array_equal(sequence.ground_truth.timestamps_s, sequence.timestamps_s)
    for frame in frames:
        assert frame.rgb.shape == (120, 160, 3) and frame.rgb.std() > 20
        assert (frame.depth_m > 0).mean() > 0.8
        assert 0.5 < np.median(frame.depth_m) < 4.0
    assert sorted(path.name for path in rendered.iterdir()) == [
        *("camera.toml", "depth", "depth.txt", "groundtruth.txt", "rgb", "rgb.txt")
    ]


def test_the_same_seed_gives_the_same_bytes(rendered, built_rooms, tmp_path):
    built_rooms.cache_clear()
    again, other = render_small(tmp_path / "again"), render_small(tmp_path / "other", seed=1)
    assert contents(again) == contents(rendered)
    assert all(
        data != contents(rendered)[name]
        for name, data in contents(other).items()
        if name.startswith(("rgb/", "depth/", "groundtruth"))
    )


def test_a_larger_room_looks_the_same_and_most_of_it_is_beyond_the_sensors_range(
    rendered, tmp_path
):
    render_sequence(tmp_path / "large", seconds=0.2, camera=SMALL, enlarged=3.0)
    folders = (rendered, tmp_path / "large")
    usual, large = (open_sequence(folder, InputConfig()) for folder in folders)
    steps_m = [np.diff(each.ground_truth.T_world_cam[:, :3, 3], axis=0) for each in (usual, large)]
    np.testing.assert_allclose(steps_m[1], 3.0 * steps_m[0], atol=1e-6)
    for small, far in zip(usual, large, strict=True):
        np.testing.assert_array_equal(small.rgb, far.rgb)
        seen = (small.depth_m > 0.0) & (far.depth_m > 0.0)
        assert 0.02 < seen.mean() < 0.5 * (small.depth_m > 0.0).mean()
        assert np.median(far.depth_m[seen] / small.depth_m[seen]) == pytest.approx(3.0, rel=0.05)
        assert far.depth_m.max() < 5.1


def test_more_frames_a_second_are_more_of_the_same_path(rendered, tmp_path):
    render_sequence(tmp_path / "fast", seconds=0.2, camera=SMALL, frames_per_s=60.0)
    folders = (rendered, tmp_path / "fast")
    usual, fast = (open_sequence(folder, InputConfig()).ground_truth for folder in folders)
    np.testing.assert_allclose(fast.timestamps_s, 100.0 + np.arange(12) / 60, atol=1e-6)
    np.testing.assert_allclose(fast.T_world_cam[::4], usual.T_world_cam, atol=1e-6)


def test_geometry_finds_the_true_motion(tmp_path):
    camera = Camera(320, 240, 262.5, 262.5, 159.5, 119.5)
    render_sequence(tmp_path / "sequence", seconds=0.27, camera=camera)
    sequence = open_sequence(tmp_path / "sequence", InputConfig())
    extractor = FeatureExtractor(camera, FeaturesConfig())
    features = [extractor.extract(grey_of(frame.rgb), frame.depth_m) for frame in sequence]
    truth = sequence.ground_truth.T_world_cam
    for i in range(1, len(features)):
        outcome = estimate_relative_pose(
            features[i - 1], features[i], camera, VerificationConfig()
        ).outcome
        assert isinstance(outcome, RelativePose)
        error = se3.inverse(outcome.T_ref_query) @ se3.inverse(truth[i - 1]) @ truth[i]
        assert se3.translation_norm(error) < 0.012
        assert np.degrees(se3.rotation_angle(error)) < 0.6


def test_progress_counts_up_to_the_number_of_frames(tmp_path):
    seen = []
    render_small(tmp_path / "sequence", progress=lambda *counts: seen.append(counts))
    assert seen == [(1, 3), (2, 3), (3, 3)]


def test_an_interrupted_rendering_leaves_nothing_behind(tmp_path):
    def interrupt(done, total):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        render_small(tmp_path / "sequence", progress=interrupt)
    assert list(tmp_path.iterdir()) == []


def test_an_empty_folder_is_filled_and_missing_parents_are_made(tmp_path):
    (tmp_path / "empty").mkdir()
    render_small(tmp_path / "empty")
    assert (tmp_path / "empty" / "rgb.txt").is_file()
    render_small(tmp_path / "a" / "b")
    assert (tmp_path / "a" / "b" / "rgb.txt").is_file()


def test_nothing_is_overwritten(tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("do not lose")
    for path in (tmp_path / "mine", tmp_path / "mine" / "thesis.txt"):
        with pytest.raises(SlamError, match="something already") as error:
            render_small(path)
        assert "\n" not in str(error.value) and str(error.value).endswith(str(path))
    assert [path.name for path in tmp_path.rglob("*")] == ["mine", "thesis.txt"]


def test_a_folder_that_cannot_be_made_is_one_clear_line(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SlamError, match="cannot write the rendered sequence") as error:
        render_small(tmp_path / "file" / "sequence")
    assert "\n" not in str(error.value)


def test_depth_is_stored_as_the_benchmark_does(rendered):
    depth = cv2.imread(str(next((rendered / "depth").iterdir())), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    assert 0.5 * 5000 < np.median(depth[depth > 0]) < 4.0 * 5000


def motions(T_world_cam, frames):
    return se3.inverse(T_world_cam[:-frames]) @ T_world_cam[frames:]


@pytest.mark.parametrize("seed", range(5))
def test_a_camera_that_can_be_tracked_and_comes_back(seed):
    T_world_cam = drive(np.arange(2 * FRAMES_PER_LAP) / FRAMES_PER_S, seed)
    step = motions(T_world_cam, 1)
    assert se3.translation_norm(step).max() < 0.035
    assert np.degrees(se3.rotation_angle(step)).max() < 3.0
    lap = motions(T_world_cam, FRAMES_PER_LAP)
    apart_m, apart_deg = se3.translation_norm(lap), np.degrees(se3.rotation_angle(lap))
    assert 0.05 < np.median(apart_m) < 0.15 and apart_m.max() < 0.2
    assert 2.0 < np.median(apart_deg) < 15.0


def test_a_camera_held_upright_inside_the_room():
    T_world_cam = drive(np.arange(2 * FRAMES_PER_LAP) / FRAMES_PER_S, 0)
    R = T_world_cam[:, :3, :3]
    assert np.allclose(R @ R.transpose(0, 2, 1), np.eye(3))
    assert np.allclose(np.linalg.det(R), 1.0)
    assert (R[:, 2, 1] < -0.9).all()  # image down is world down
    assert (np.abs(T_world_cam[:, :2, 3]) < [1.0, 0.8]).all()
    assert (np.abs(T_world_cam[:, 2, 3] - 1.3) < 0.15).all()


def test_a_longer_drive_begins_like_a_shorter_one():
    assert np.array_equal(
        drive(np.arange(10) / FRAMES_PER_S, 1), drive(np.arange(90) / FRAMES_PER_S, 1)[:10]
    )
    assert not np.allclose(
        drive(np.arange(10) / FRAMES_PER_S, 1), drive(np.arange(10) / FRAMES_PER_S, 2)
    )
