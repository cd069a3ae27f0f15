# SPDX-License-Identifier: Apache-2.0
import io
import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import open3d as o3d
import pytest

from placerec.errors import LoopcloseError
from slam.config import MapConfig
from slam.datasets.cameras import FREIBURG
from slam.geometry import se3
from slam.geometry.features import undistort
from slam.output.mesh import before_and_after, separate_process
from slam.output.mesh.separate_process import MESHES, meshes_apart, straight_pixels
from slam.result import MapMesh, MapMeshes, SlamResult
from slam.tracking.tracked_frame import preview
from slam.types import (
    Camera,
    Frame,
    Keyframe,
    LoopAttempt,
    Rejection,
    RejectionReason,
    RelativePose,
    SlamError,
    Trajectory,
)

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
VOXELS = MapConfig(voxel_m=0.02, max_depth_m=3.0)
FAILED = Rejection(RejectionReason.FEW_MATCHES, 1.0, 20.0)


def looking_at_a_wall(depth_m=1.5, count=6, drift_m=0.12, loop=None):
    """Return a run before a wall; by odometry, the second half sees it further away."""
    rng = np.random.default_rng(0)
    shape = (CAMERA.height, CAMERA.width)
    keyframes = []
    for number in range(count):
        noisy_m = depth_m * rng.normal(1.0, 0.0013, shape)
        shown = Frame(float(number), np.full((*shape, 3), (200, 100, 50), np.uint8), noisy_m)
        keyframes.append(Keyframe(number, float(number), np.eye(4), None, preview(shown)))
    T_world_kf = np.tile(np.eye(4), (count, 1, 1))
    drifted = T_world_kf.copy()
    drifted[count // 2 :, 2, 3] += drift_m
    times_s = np.arange(float(count))
    odometry, corrected = Trajectory(times_s, drifted), Trajectory(times_s, T_world_kf)
    outcome = loop or RelativePose(np.eye(4), np.eye(6))
    return SlamResult(
        camera=CAMERA,
        keyframes=tuple(keyframes),
        T_world_kf=T_world_kf,
        odometry=odometry,
        live=odometry,
        without_loops=odometry,
        trajectory=corrected,
        links=(),
        attempts=(LoopAttempt(count - 1, 0, 0.9, None, outcome, 1.0),),
        similarities=np.zeros((0, 0), np.float32),
        min_similarity=0.5,
        untracked_s=np.zeros(0),
        stage_seconds={},
        warnings=(),
    )


def names(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.fixture
def here(monkeypatch):
    """Do what the process does in this one, which has loaded Open3D already."""

    def asked(told, images, complaints):
        content, answer = b"".join(each.tobytes() for each in images), io.BytesIO()
        of = before_and_after.Asked(*json.loads(told))
        np.savez(answer, **before_and_after.made(of, io.BytesIO(content)))
        return answer.getvalue(), 0

    monkeypatch.setattr(separate_process, "_asked", asked)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    folder = tmp_path_factory.mktemp("meshes")
    return folder, meshes_apart(folder, looking_at_a_wall(), VOXELS)


def test_a_double_wall_becomes_a_single_one(made):
    folder, meshes = made
    assert names(folder) == sorted(MESHES)
    before, after = (o3d.io.read_triangle_mesh(str(folder / name)) for name in MESHES)
    depths_m = [np.asarray(mesh.vertices)[:, 2] for mesh in (before, after)]
    assert (depths_m[0] < 1.56).mean() > 0.3 and (depths_m[0] > 1.6).mean() > 0.3
    np.testing.assert_allclose(depths_m[1], 1.5, atol=0.02)
    colours = 255.0 * np.asarray(after.vertex_colors)
    np.testing.assert_allclose(colours, np.tile([200, 100, 50], (len(colours), 1)), atol=2.0)
    normals = np.asarray(after.compute_triangle_normals().triangle_normals)
    assert np.median(normals[:, 2]) < -0.9  # it faces the camera
    assert meshes.after.entropy < meshes.before.entropy - 0.5
    assert meshes.after.off_plane_m == pytest.approx(0.002, rel=0.2)
    assert meshes.before.off_plane_m == pytest.approx(0.06, rel=0.2)
    assert meshes.warnings == () and ": sharper; points" in meshes.explanation


def test_the_same_run_gives_the_same_bytes_here_and_apart(made, here, tmp_path):
    folder, meshes = made
    again = meshes_apart(tmp_path, looking_at_a_wall(), VOXELS)
    for name in MESHES:
        assert (tmp_path / name).read_bytes() == (folder / name).read_bytes()
    for one, other in ((meshes.before, again.before), (meshes.after, again.after)):
        assert (one.entropy, one.off_plane_m) == (other.entropy, other.off_plane_m)
        np.testing.assert_array_equal(one.overview, other.overview)
        np.testing.assert_array_equal(one.closer, other.closer)


def test_pictures_show_the_wall(made):
    _, meshes = made
    for picture in (meshes.after.overview, meshes.after.closer):
        wall = (picture[..., 0] > 1.5 * picture[..., 2]) & (picture[..., 0] > 60)
        assert picture.dtype == np.uint8 and picture.ndim == 3
        assert 0.1 < wall.mean() < 1.0


def test_a_map_that_lost_sharpness_is_warned_of(here, tmp_path):
    good = looking_at_a_wall()
    worse = replace(good, odometry=good.trajectory, T_world_kf=good.odometry.T_world_cam)
    (warning,) = meshes_apart(tmp_path, worse, VOXELS).warnings
    assert warning.startswith("the map is less sharp after loop closure than before")


def test_without_loops_there_is_one_mesh(here, tmp_path):
    meshes = meshes_apart(tmp_path, looking_at_a_wall(loop=FAILED), VOXELS)
    assert names(tmp_path) == ["mesh_after.ply"]
    assert meshes.before is None and meshes.warnings == ()
    assert meshes.explanation.endswith("no loop was closed, so there is one mesh only")


def test_what_a_lens_bends_is_straight():
    camera = FREIBURG["1"]
    shape = camera.preview_shape
    rows, columns, is_outside = straight_pixels(camera, camera)
    v, u = np.indices(shape)
    pixels = 2.0 * np.column_stack([columns.ravel(), rows.ravel()])
    seen = undistort(pixels, camera).reshape(*shape, 2) / 2.0
    off_px = np.linalg.norm(seen - np.dstack([u, v]), axis=2)
    assert off_px[~is_outside].max() < 1.2  # rounded to whole pixels, and these are stretched
    assert np.linalg.norm(np.dstack([columns - u, rows - v]), axis=2).max() > 4.0
    assert 0.0 < is_outside.mean() < 0.2


def test_another_camera_shows_the_same_where_it_sees_it():
    camera, other = CAMERA, Camera(200, 200, 260.0, 260.0, 99.5, 99.5)
    rows, columns, is_outside = straight_pixels(camera, other)
    v, u = 2.0 * np.indices(camera.preview_shape)
    ray_x, ray_y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    seen_x, seen_y = (2.0 * columns - other.cx) / other.fx, (2.0 * rows - other.cy) / other.fy
    assert np.abs(ray_x - seen_x)[~is_outside].max() < 0.005
    assert np.abs(ray_y - seen_y)[~is_outside].max() < 0.005
    assert 0.2 < is_outside.mean() < 0.6  # it sees 42 degrees, and the camera 63


def test_open3d_is_not_loaded_here():
    module = "slam.output.mesh.separate_process"
    script = f"import sys, {module}; print('open3d' in sys.modules)"
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert ran.stdout == "False\n"


def test_without_depth_there_is_one_clear_line(here, tmp_path):
    with pytest.raises(SlamError, match=r"^no surface was seen by two keyframes with depth$"):
        meshes_apart(tmp_path, looking_at_a_wall(depth_m=0.0, count=2), VOXELS)
    assert names(tmp_path) == []


def test_a_folder_that_cannot_be_written_to_is_one_clear_line(here, tmp_path):
    with pytest.raises(LoopcloseError, match=r"^cannot write mesh_before\.ply: No such file"):
        meshes_apart(tmp_path / "none", looking_at_a_wall(count=2, drift_m=0.0), VOXELS)


def test_a_missing_open3d_is_one_clear_line(tmp_path, monkeypatch):
    (tmp_path / "open3d.py").write_text("raise ImportError('no open3d here')")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(SlamError, match=r"^ImportError: no open3d here$"):
        meshes_apart(tmp_path, looking_at_a_wall(), VOXELS)


def test_a_process_that_is_killed_is_told_of(tmp_path, monkeypatch):
    class Process(subprocess.Popen):
        def __init__(self, *arguments, **options):
            super().__init__(*arguments, **options)
            self.kill()

    monkeypatch.setattr(separate_process.subprocess, "Popen", Process)
    with pytest.raises(SlamError, match="was ended by SIGKILL"):
        meshes_apart(tmp_path, looking_at_a_wall(), VOXELS)


def test_keyframes_without_a_place_are_left_out(here, tmp_path):
    run = looking_at_a_wall(count=4)
    T_world_kf = run.T_world_kf.copy()
    T_world_kf[0] = np.nan
    T_world_kf[1:] = se3.exp(np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0]))
    meshes = meshes_apart(tmp_path, replace(run, T_world_kf=T_world_kf), VOXELS)
    assert meshes.closer_id in (1, 2, 3)
    T_world_kf[:] = np.nan
    with pytest.raises(SlamError, match="no keyframe is on both paths"):
        meshes_apart(tmp_path, replace(run, T_world_kf=T_world_kf), VOXELS)


def test_an_odometry_in_a_frame_of_its_own_is_shown_as_any_other(here, made, tmp_path):
    run = looking_at_a_wall()
    T_map_world = se3.exp(np.array([np.pi / 2.0, 0.0, 0.3, 5.0, 0.0, 1.0]))
    elsewhere = replace(run.odometry, T_world_cam=T_map_world @ run.odometry.T_world_cam)
    before = meshes_apart(tmp_path, replace(run, odometry=elsewhere), VOXELS).before
    off = np.abs(before.overview.astype(int) - made[1].before.overview)
    assert off.mean() < 1.0


@pytest.mark.parametrize("has_before", [True, False])
def test_where_sharpness_is_not_known_no_number_is_said(has_before):
    picture = np.zeros((1, 1, 3), np.uint8)
    unknown = MapMesh(np.nan, np.nan, picture, picture)
    meshes = MapMeshes(unknown if has_before else None, unknown, 0)
    assert meshes.explanation == "too few points lie together to tell how sharp it is"
    assert meshes.warnings == ()
