# SPDX-License-Identifier: Apache-2.0
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam.datasets import Sequence, write_camera
from slam.datasets.folders.icl_nuim import CAMERA

Export = Callable[[str, Any], Path]
Fails = Callable[..., str]
Opened = Callable[[Path], Sequence]
FORMS = ("icl_nuim", "icl_nuim_original")


@pytest.fixture(scope="module")
def full_size(take: Callable[..., Any]) -> Any:
    """Return 4 frames of the benchmark's camera."""
    return take(4, CAMERA)


@pytest.fixture
def tiny(export: Export, tiny_walk: Any) -> Callable[..., Path]:
    """Write tiny frames; the benchmark's camera does not fit them, so theirs is named."""

    def written(form: str = "icl_nuim") -> Path:
        folder = export(form, tiny_walk)
        scale = 5000.0 if form == "icl_nuim" else 1.0
        write_camera(folder / "camera.toml", tiny_walk.camera_in(scale))
        return folder

    return written


def world_point_as_published(folder: Path, frame: int, u: int, v: int, depth_m: float) -> Any:
    """Unproject a pixel with what the authors publish: fy = -480 and the pose as it stands."""
    rows = np.loadtxt(folder / "traj0.gt.freiburg")
    t, quaternion = rows[rows[:, 0] == frame][0, 1:4], rows[rows[:, 0] == frame][0, 4:]
    point = depth_m * np.array([(u - 319.5) / 481.2, (v - 239.5) / -480.0, 1.0])
    return Rotation.from_quat(quaternion).as_matrix() @ point + t


def test_the_same_point_is_the_mirrored_one_of_the_published_convention(
    export: Export, full_size: Any, opened: Opened
) -> None:
    folder = export("icl_nuim", full_size)
    sequence = opened(folder)
    truth = sequence.ground_truth
    assert truth is not None
    for frame, u, v in ((1, 100, 50), (2, 500, 400), (3, 320, 10)):
        depth_m = float(sequence.frame(frame).depth_m[v, u])
        ray = np.array([(u - 319.5) / 481.2, (v - 239.5) / 480.0, 1.0, 1.0 / depth_m])
        ours = truth.T_world_cam[frame - 1] @ (depth_m * ray)
        theirs = world_point_as_published(folder, frame, u, v, depth_m)
        np.testing.assert_allclose(ours[:3], theirs * [1.0, -1.0, 1.0], atol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_two_frames_see_the_same_surfaces_at_the_same_place(
    export: Export, full_size: Any, disagreement: Callable[..., Any], form: str, opened: Opened
) -> None:
    sequence = opened(export(form, full_size))
    assert (sequence.camera.fy, len(sequence)) == (480.0, 4)
    assert sequence.warnings == ()
    off_m = disagreement(sequence, 1, 3)
    assert len(off_m) > 100_000
    assert np.median(np.abs(off_m)) < 0.002


@pytest.mark.parametrize("form", FORMS)
def test_truth_is_right_handed_and_of_each_image(
    export: Export, full_size: Any, form: str, opened: Opened
) -> None:
    truth = opened(export(form, full_size)).ground_truth
    assert truth is not None
    first = 1 if form == "icl_nuim" else 0  # the benchmark's lists leave the first pose out
    np.testing.assert_allclose(truth.timestamps_s, np.arange(first, 4) / 30.0)
    np.testing.assert_allclose(truth.T_world_cam, full_size.T_world_depth[first:], atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(truth.T_world_cam[:, :3, :3]), 1.0)


def test_distances_along_rays_become_depth(export: Export, full_size: Any, opened: Opened) -> None:
    frame = opened(export("icl_nuim_original", full_size)).frame(2)
    assert frame.depth_m.dtype == np.float32
    np.testing.assert_allclose(frame.depth_m, full_size.depth_m[2], atol=2e-5)
    assert (frame.rgb == full_size.rgb[2]).all()


def test_frames_come_by_number_with_colour_or_depth_first(
    tiny: Callable[..., Path], opened: Opened
) -> None:
    folder = tiny()
    lines = (folder / "associations.txt").read_text().splitlines()
    turned = [" ".join([*line.split()[2:], *line.split()[:2]]) for line in lines]
    (folder / "associations.txt").write_text("\n".join(["# frames", *turned[::-1]]))
    sequence = opened(folder)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == list(range(6))
    np.testing.assert_allclose(sequence.timestamps_s, np.arange(6) / 30.0)
    assert "associations.txt is not in the order of time" in sequence.warnings[0]


@pytest.mark.parametrize(
    ("line", "said"),
    [
        ("7 depth/7.png 7", "line 7 is not"),
        ("7 depth/7.png 8 rgb/7.png", "the same whole number twice"),
        ("0.2 depth/7.png 0.2 rgb/7.png", "line 7 is not"),
        ("x depth/7.png x rgb/7.png", "line 7 is not"),
        ("nan depth/7.png nan rgb/7.png", "line 7 is not"),
    ],
)
def test_a_malformed_association_is_named(
    tiny: Callable[..., Path], line: str, said: str, fails: Fails
) -> None:
    folder = tiny()
    with (folder / "associations.txt").open("a") as file:
        file.write(line)
    assert fails(folder, said).endswith("associations.txt")


def test_an_empty_list_is_named(tiny: Callable[..., Path], fails: Fails) -> None:
    folder = tiny()
    (folder / "associations.txt").write_text("")
    fails(folder, "the list names no image")


def test_a_pose_that_is_none_is_named(tiny: Callable[..., Path], fails: Fails) -> None:
    folder = tiny()
    (folder / "traj0.gt.freiburg").write_text("1 0 0 zero 0 0 0 1\n")
    assert fails(folder, "line 1 is not").endswith("traj0.gt.freiburg")


def test_two_truths_are_one_too_many(tiny: Callable[..., Path], fails: Fails) -> None:
    folder = tiny()
    (folder / "livingRoom0.gt.freiburg").write_text("1 0 0 0 0 0 0 1\n")
    fails(folder, "livingRoom0.gt.freiburg and traj0.gt.freiburg")


def test_images_of_another_size_are_named(export: Export, tiny_walk: Any, fails: Fails) -> None:
    fails(export("icl_nuim", tiny_walk), "has 32x24 pixels but the camera 640x480")


@pytest.mark.parametrize(
    ("content", "why"),
    [
        ("1.0 2.0 3.0", "the file is cut off: 3 numbers for 32x24 pixels"),
        ("1.0 two 3.0", "not a list of numbers"),
    ],
)
def test_a_broken_depth_text_is_skipped(
    tiny: Callable[..., Path], content: str, why: str, opened: Opened
) -> None:
    folder = tiny("icl_nuim_original")
    (folder / "scene_00_0002.depth").write_text(content)
    (folder / "scene_00_0004.depth").unlink()
    sequence = opened(folder)
    assert [frame.rgb[0, 0, 0] for frame in sequence] == [0, 1, 3, 5]
    assert [broken.why for broken in sequence.skipped] == [why, "the file is missing"]


def test_an_original_pose_may_be_missing_but_not_wrong(
    tiny: Callable[..., Path], fails: Fails, opened: Opened
) -> None:
    folder = tiny("icl_nuim_original")
    (folder / "scene_00_0002.txt").unlink()
    truth = opened(folder).ground_truth
    assert truth is not None and len(truth) == 5
    for text in ("cam_pos = [0, 0, 0]';", "cam_pos = [0, 0]';\ncam_dir = [0, 0, 1]';"):
        (folder / "scene_00_0003.txt").write_text(text)
        assert fails(folder, "are not all there").endswith("scene_00_0003.txt")
    text = "cam_pos = [0, 0, 0]';\ncam_dir = [0, 0, 1]';\ncam_up = [0, 0, 1]';"
    (folder / "scene_00_0003.txt").write_text(text)
    fails(folder, "not finite")
    for file in folder.glob("*.txt"):
        file.unlink()
    assert opened(folder).ground_truth is None
