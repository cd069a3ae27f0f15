# SPDX-License-Identifier: Apache-2.0
import errno
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from placerec.recognizers.gradients import GradientRecognizer
from slam.config import EvaluationConfig, InputConfig
from slam.datasets import open_sequence, write_camera
from slam.datasets.formats import FORMATS, find_format
from slam.evaluation.drift import trajectory_error
from slam.system import Slam
from slam.types import Trajectory

MakeFolder = Callable[..., Path]
Fails = Callable[..., str]
Export = Callable[[str, Any], Path]
CONFIG = InputConfig()
NAMES = {
    "tum": "TUM RGB-D",
    "icl_nuim": "ICL-NUIM",
    "associations": "associated images",
    "icl_nuim_original": "ICL-NUIM as rendered",
    "seven_scenes": "7-Scenes",
    "replica": "Replica",
    "scannet": "ScanNet",
    "stray_scanner": "Stray Scanner",
    "record3d": "Record3D",
    "realsense": "RealSense",
    "open3d": "Open3D or Redwood",
    "open3d_sample": "Open3D's samples",
}
NOT_COMPARED = ("tum", "open3d_sample")  # the reference; open3d's folder without its camera
WITHOUT_TRUTH = ("realsense", "stray_scanner", "record3d")
OF_ONE_CAMERA = ("icl_nuim", "icl_nuim_original", "seven_scenes")


def test_every_format_is_known() -> None:
    # Bags are tested in their own folder.
    names = [each.name for each in FORMATS]
    assert sorted(names) == sorted([*NAMES.values(), "ROS 2 bag"])


@pytest.mark.parametrize("name", NAMES)
def test_a_format_is_told_by_what_the_folder_holds(
    export: Export, tiny_walk: Any, name: str
) -> None:
    found = find_format(export(name, tiny_walk))
    assert found is not None
    assert found.name == NAMES[name]


def tracked(folder: Path) -> Trajectory:
    """Return what odometry alone makes of a recording, every frame of it."""
    sequence = open_sequence(folder, CONFIG)
    slam = Slam(sequence.camera, GradientRecognizer())
    for frame in sequence:
        slam.process(frame)
    odometry = slam.finish().odometry
    np.testing.assert_allclose(odometry.timestamps_s, sequence.timestamps_s)
    assert (sequence.ground_truth is None) == (folder.name in WITHOUT_TRUTH)
    if sequence.ground_truth:
        error = trajectory_error(odometry, sequence.ground_truth, EvaluationConfig())
        assert error.ate_rmse_m < 0.01
        assert error.matched_share >= 11 / 12  # ICL-NUIM does not tell the first pose
    return odometry


@pytest.fixture(scope="module")
def reference(tmp_path_factory: pytest.TempPathFactory, walk: Any, writers: Any) -> Trajectory:
    """Return the odometry on the frames in the TUM benchmark's format."""
    return tracked(writers["tum"](tmp_path_factory.mktemp("tum"), walk))


@pytest.mark.parametrize("name", [name for name in NAMES if name not in NOT_COMPARED])
def test_the_same_frames_give_the_same_odometry_in_every_format(
    export: Export, walk: Any, reference: Trajectory, name: str
) -> None:
    folder = export(name, walk)
    if name in OF_ONE_CAMERA:
        scale = {"icl_nuim": 5000.0, "icl_nuim_original": 1.0, "seven_scenes": 1000.0}[name]
        write_camera(folder / "camera.toml", walk.camera_in(scale))
    odometry = tracked(folder)
    np.testing.assert_allclose(odometry.timestamps_s, reference.timestamps_s, atol=1e-6)
    assert len(odometry) == 12
    # Depth in whole millimetres is not quite depth in fifths of them.
    np.testing.assert_allclose(odometry.T_world_cam, reference.T_world_cam, atol=0.0005)


def test_a_relative_path_has_its_folders_name(
    make_folder: MakeFolder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(make_folder())
    assert open_sequence(Path(), CONFIG).name == "tiny"


def test_a_missing_folder_is_named(tmp_path: Path, fails: Fails) -> None:
    assert "fr1_desk" in fails(tmp_path / "none", "no such folder")


def test_a_folder_that_may_not_be_read_is_one_line(
    make_folder: MakeFolder, monkeypatch: pytest.MonkeyPatch, fails: Fails
) -> None:
    def forbidden(path: Path) -> bool:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "is_file", forbidden)
    fails(make_folder(), "cannot look into the folder: Permission denied")


def test_a_file_is_not_a_folder(tmp_path: Path, fails: Fails) -> None:
    (tmp_path / "a.tgz").write_text("")
    fails(tmp_path / "a.tgz", "or a bag (.bag, .mcap, .db3), found a file")


def test_another_kind_of_folder_says_what_was_found_and_what_each_format_needs(
    tmp_path: Path, fails: Fails
) -> None:
    said = fails(tmp_path, "the folder holds nothing (TUM RGB-D: rgb.txt, depth.txt; ICL-NUIM:")
    assert all(f"{name}: " in said for name in NAMES.values())
    assert "color/ or rgb/ or image/" in said and said.endswith(str(tmp_path))
    for name in "abcdefg":
        (tmp_path / name).write_text("")
    fails(tmp_path, "the folder holds a, b, c, d, e, ...")


def test_the_folder_above_a_recording_points_to_it(
    export: Export, tiny_walk: Any, fails: Fails
) -> None:
    fails(export("seven_scenes", tiny_walk).parent, "did you mean its folder seven_scenes?")


@pytest.mark.parametrize(
    ("name", "lost", "said"),
    [
        ("tum", "depth.txt", "it would be TUM RGB-D with depth.txt"),
        ("icl_nuim", "traj0.gt.freiburg", "but then there is a *.gt.freiburg in the folder"),
        ("scannet", "intrinsic/intrinsic_color.txt", "with intrinsic/intrinsic_color.txt"),
        ("realsense", "intrinsics.json", "RealSense with intrinsics.json"),
    ],
)
def test_what_is_missing_is_named(
    export: Export, tiny_walk: Any, name: str, lost: str, said: str, fails: Fails
) -> None:
    folder = export(name, tiny_walk)
    (folder / lost).unlink()
    (folder / "camera.toml").unlink(missing_ok=True)
    fails(folder, said)


def test_a_list_of_associations_does_not_hide_a_camera(export: Export, tiny_walk: Any) -> None:
    folder = export("open3d", tiny_walk)
    (folder / "associations.txt").write_text("0.1 color/00000.png 0.1 depth/00000.png\n")
    found = find_format(folder)
    assert found is not None and found.name == "Open3D or Redwood"
