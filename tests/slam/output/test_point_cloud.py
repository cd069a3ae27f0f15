# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import cv2
import numpy as np
import open3d as o3d
import pytest

from placerec.errors import LoopcloseError
from slam.config import MapConfig
from slam.datasets.cameras import FREIBURG
from slam.geometry import se3
from slam.output.point_cloud import PointCloud, VoxelMeans, fuse, write_map
from slam.result import SlamResult
from slam.tracking.tracked_frame import preview
from slam.types import Camera, Frame, Keyframe, Trajectory

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
COARSE = MapConfig(voxel_m=0.05)


def keyframe_of(number, rgb, depth_m):
    shown = preview(Frame(float(number), rgb, np.asarray(depth_m, np.float32)))
    return Keyframe(number, float(number), np.eye(4), None, shown)


def coloured(shape, colour):
    return np.full((*shape, 3), colour, np.uint8)


def wall(number=0, depth_m=2.0, colour=(200, 100, 50), camera=CAMERA):
    shape = (camera.height, camera.width)
    return keyframe_of(number, coloured(shape, colour), np.full(shape, depth_m))


def result_of(keyframes, T_world_kf=None, camera=CAMERA):
    T_world_kf = np.tile(np.eye(4), (len(keyframes), 1, 1)) if T_world_kf is None else T_world_kf
    nothing = Trajectory(np.zeros(0), np.zeros((0, 4, 4)))
    return SlamResult(
        camera=camera,
        keyframes=tuple(keyframes),
        T_world_kf=np.asarray(T_world_kf),
        odometry=nothing,
        live=nothing,
        without_loops=nothing,
        trajectory=nothing,
        links=(),
        attempts=(),
        similarities=np.zeros((0, 0), np.float32),
        min_similarity=0.5,
        untracked_s=np.zeros(0),
        stage_seconds={},
        warnings=(),
    )


def points_of(cloud):
    return cloud.points_m


def test_a_wall_is_a_plane_of_the_right_size_and_colour():
    cloud = fuse(result_of([wall()]), COARSE)
    points_m = points_of(cloud)
    np.testing.assert_allclose(points_m[:, 2], 2.0)
    width_m, height_m = 2.0 * 160 / 130, 2.0 * 120 / 130
    assert np.ptp(points_m[:, 0]) == pytest.approx(width_m, abs=0.12)
    assert np.ptp(points_m[:, 1]) == pytest.approx(height_m, abs=0.12)
    np.testing.assert_allclose(points_m.mean(axis=0)[:2], 0.0, atol=0.05)
    np.testing.assert_allclose(cloud.colours, np.tile([200, 100, 50], (len(points_m), 1)))


@pytest.mark.parametrize("camera", [CAMERA, FREIBURG["1"]], ids=["ideal", "distorting"])
def test_points_project_back_into_the_pixels_they_came_from(camera):
    # One red pixel block in a grey wall: where it lies in space is where it was seen.
    rgb = coloured((camera.height, camera.width), (128, 128, 128))
    v, u = camera.height // 16 * 4, camera.width // 32 * 4
    rgb[v : v + 8, u : u + 8] = (255, 0, 0)
    depth_m = np.full((camera.height, camera.width), 1.5)
    fine = MapConfig(voxel_m=0.001)
    cloud = fuse(result_of([keyframe_of(0, rgb, depth_m)], camera=camera), fine)
    is_red = cloud.colours[:, 1] < 25
    projected, _ = cv2.projectPoints(
        points_of(cloud)[is_red],
        np.zeros(3),
        np.zeros(3),
        camera.matrix,
        np.array(camera.distortion),
    )
    assert is_red.sum() == 4
    centre_px = projected.reshape(-1, 2).mean(axis=0)
    np.testing.assert_allclose(centre_px, [u + 2.0, v + 2.0], atol=0.6)


def test_keyframes_of_other_cameras_see_the_same_wall():
    narrow = Camera(80, 60, 130.0, 130.0, 39.5, 29.5)
    own = wall()
    shown = keyframe_of(1, coloured((60, 80), (200, 100, 50)), np.full((60, 80), 2.0))
    other = replace(shown, camera=narrow)
    cloud = fuse(result_of([own, other]), COARSE)
    alone = fuse(result_of([own]), COARSE)
    width_m = [np.ptp(points_of(each)[:, 0]) for each in (cloud, alone)]
    assert width_m[0] == pytest.approx(width_m[1], abs=0.05)
    narrow_m = np.ptp(points_of(fuse(result_of([other]), COARSE))[:, 0])
    assert narrow_m == pytest.approx(0.5 * width_m[1], abs=0.1)


def test_each_voxel_holds_the_means_that_open3d_finds():
    rng = np.random.default_rng(0)
    points_m, colours = rng.normal(size=(5000, 3)), rng.uniform(0.0, 255.0, (5000, 3))
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points_m))
    cloud.colors = o3d.utility.Vector3dVector(colours / 255.0)
    # It begins to count voxels half of one before the least point.
    expected = cloud.voxel_down_sample(0.25)
    least_m = points_m.min(axis=0) - 0.125
    found = PointCloud(points_m - least_m, colours).thinned(0.25)
    for ours, theirs in (
        (found.points_m + least_m, expected.points),
        (found.colours / 255.0, expected.colors),
    ):
        ours, theirs = (each[np.lexsort(each.T)] for each in (ours, np.asarray(theirs)))
        np.testing.assert_allclose(ours, theirs, atol=1e-6)


def test_keyframes_are_placed_by_their_corrected_poses():
    T_world_kf = [np.eye(4), se3.exp(np.array([0.0, np.pi / 2, 0.0, 0.0, 0.0, 0.0]))]
    keyframes = [wall(0, 2.0, (255, 0, 0)), wall(1, 3.0, (0, 0, 255))]
    cloud = fuse(result_of(keyframes, T_world_kf), COARSE)
    is_red = cloud.colours[:, 0] > 127
    np.testing.assert_allclose(points_of(cloud)[is_red][:, 2], 2.0)
    np.testing.assert_allclose(points_of(cloud)[~is_red][:, 0], 3.0)


def test_what_several_keyframes_see_is_there_once():
    once = fuse(result_of([wall()]), COARSE)
    thrice = fuse(result_of([wall(i) for i in range(3)]), COARSE)
    assert len(thrice.points_m) == len(once.points_m)


def test_means_that_outgrow_their_room_are_as_if_there_had_been_room_for_all():
    rng = np.random.default_rng(0)
    points_m, colours = rng.random((3000, 3)), rng.integers(0, 256, (3000, 3)).astype(np.float32)
    at_once = PointCloud(points_m, colours).thinned(0.1)
    means = VoxelMeans(0.1, room=1)
    for first in range(0, 3000, 100):
        part = slice(first, first + 100)
        means.add(PointCloud(points_m[part], colours[part]))
    in_turn = means.cloud()
    np.testing.assert_array_equal(in_turn.points_m, at_once.points_m)
    np.testing.assert_array_equal(in_turn.colours, at_once.colours)


def test_a_map_of_any_width_has_a_number_per_voxel():
    rng = np.random.default_rng(0)
    voxels = rng.integers(-(2**40), 2**40, (2000, 3)).astype(np.float64)
    points_m = np.concatenate([voxels + 0.25, voxels + 0.75])
    cloud = PointCloud(points_m, np.repeat([[0.0], [200.0]], 2000, axis=0) * np.ones(3)).thinned(1)
    assert len(cloud.points_m) == 2000
    order, expected = np.lexsort(cloud.points_m.T), voxels + 0.5
    np.testing.assert_array_equal(cloud.points_m[order], expected[np.lexsort(expected.T)])
    np.testing.assert_array_equal(cloud.colours, 100.0)


def test_points_are_no_denser_than_the_voxels():
    counts = [
        len(fuse(result_of([wall()]), MapConfig(voxel_m=voxel_m)).points_m)
        for voxel_m in (0.1, 0.3, 0.9)
    ]
    assert counts[0] > 4 * counts[1] > 16 * counts[2] > 0


def two_walls(size=1.0, far=5.1):
    depth_m = np.full((120, 160), 2.0)
    depth_m[:, 84:] = far
    depth_m[:60] = 0.0
    return result_of([keyframe_of(0, coloured((120, 160), (9, 9, 9)), size * depth_m)])


def test_unknown_and_far_depth_is_left_out():
    points_m = points_of(fuse(two_walls(), COARSE))
    assert (points_m[:, 0] < 0.1).all() and (points_m[:, 1] > -0.05).all()
    np.testing.assert_allclose(points_m[:, 2], 2.0)
    assert points_of(fuse(two_walls(far=4.9), COARSE))[:, 2].max() == pytest.approx(4.9)
    named = MapConfig(voxel_m=0.05, max_depth_m=6.0)
    assert points_of(fuse(two_walls(), named))[:, 2].max() == pytest.approx(5.1)


@pytest.mark.parametrize("size", [0.125, 8.0])
def test_what_is_far_and_how_fine_the_map_is_depend_on_what_is_seen(size):
    usual, other = (points_of(fuse(two_walls(each), MapConfig())) for each in (1.0, size))
    assert len(usual) == len(other) > 100
    np.testing.assert_allclose(other[:, 2], 2.0 * size)
    # A wall at 1.5 m: its pixels are denser than the voxels, which are a centimetre wide.
    close = points_of(fuse(result_of([wall(depth_m=1.5)]), MapConfig()))
    named = points_of(fuse(result_of([wall(depth_m=1.5)]), MapConfig(voxel_m=0.01)))
    assert len(close) == len(named)


def test_the_file_is_a_ply_that_open3d_reads(tmp_path):
    result = result_of([wall()])
    write_map(tmp_path / "map.ply", result, COARSE)
    cloud, read = fuse(result, COARSE), o3d.io.read_point_cloud(str(tmp_path / "map.ply"))
    np.testing.assert_allclose(np.asarray(read.points), cloud.points_m, atol=1e-6)
    np.testing.assert_allclose(np.asarray(read.colors) * 255, cloud.colours, atol=0.5)
    assert [path.name for path in tmp_path.iterdir()] == ["map.ply"]


def test_the_same_run_gives_the_same_bytes(tmp_path, frames):
    keyframes = [
        Keyframe(i, frame.timestamp_s, np.eye(4), None, preview(frame))
        for i, frame in enumerate(frames[:3])
    ]
    result = result_of(keyframes, camera=Camera(320, 240, 262.5, 262.5, 159.5, 119.5))
    for name in ("one.ply", "two.ply"):
        write_map(tmp_path / name, result, MapConfig())
    assert (tmp_path / "one.ply").read_bytes() == (tmp_path / "two.ply").read_bytes()


def test_a_map_without_any_point_is_an_empty_file_of_the_right_kind(tmp_path):
    write_map(tmp_path / "map.ply", result_of([wall(depth_m=0.0)]), COARSE)
    assert (tmp_path / "map.ply").read_bytes().startswith(b"ply\n")
    assert b"element vertex 0\n" in (tmp_path / "map.ply").read_bytes()


@pytest.mark.parametrize("voxel_m", [1e-4, 1e6])
def test_the_finest_and_the_coarsest_map_work(tmp_path, voxel_m):
    write_map(tmp_path / "map.ply", result_of([wall()]), MapConfig(voxel_m=voxel_m))


def test_voxels_too_fine_are_refused_before_the_run():
    with pytest.raises(ValueError, match="voxel_m"):
        MapConfig(voxel_m=1e-9)


def test_a_folder_that_is_not_there_is_one_clear_line(tmp_path):
    with pytest.raises(LoopcloseError, match=r"cannot write map\.ply") as error:
        write_map(tmp_path / "none" / "map.ply", result_of([wall()]), COARSE)
    assert "\n" not in str(error.value)


def test_odd_image_sizes_are_fine():
    camera = replace(CAMERA, width=161, height=119)
    cloud = fuse(result_of([wall(camera=camera)], camera=camera), COARSE)
    assert np.ptp(points_of(cloud)[:, 0]) == pytest.approx(2.0 * 161 / 130, abs=0.12)


def test_a_keyframe_without_a_place_is_left_out():
    placed, apart = wall(0), wall(1, depth_m=1.0)
    T_world_kf = np.array([np.eye(4), np.full((4, 4), np.nan)])
    cloud = fuse(result_of([placed, apart], T_world_kf), COARSE)
    np.testing.assert_array_equal(points_of(cloud), points_of(fuse(result_of([placed]), COARSE)))
