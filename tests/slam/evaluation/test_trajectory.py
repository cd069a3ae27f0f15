# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from placerec.errors import LoopcloseError
from slam.evaluation.trajectory import (
    align,
    associate,
    path_length_m,
    poses_at,
    read_tum,
    write_tum,
)
from slam.geometry import se3
from slam.types import SlamError, Trajectory


def at(stamps_s):
    stamps_s = np.asarray(stamps_s, dtype=np.float64)
    return Trajectory(stamps_s, np.tile(np.eye(4), (len(stamps_s), 1, 1)))


def wandering(count, seed=1):
    rng = np.random.default_rng(seed)
    tangents = np.hstack([rng.normal(0.0, 0.5, (count, 3)), rng.normal(0.0, 2.0, (count, 3))])
    stamps_s = 1305031449.7996 + np.arange(count) / 30.0
    return Trajectory(np.round(stamps_s, 6), np.stack([se3.exp(tangent) for tangent in tangents]))


def test_tum_round_trip_keeps_a_nanometre(tmp_path):
    trajectory = wandering(50)
    write_tum(tmp_path / "t.txt", trajectory)
    again = read_tum(tmp_path / "t.txt")
    np.testing.assert_array_equal(again.timestamps_s, trajectory.timestamps_s)
    np.testing.assert_allclose(again.T_world_cam, trajectory.T_world_cam, atol=5e-9)
    write_tum(tmp_path / "again.txt", trajectory)
    assert (tmp_path / "again.txt").read_bytes() == (tmp_path / "t.txt").read_bytes()


def test_what_a_written_line_looks_like(tmp_path):
    T_world_cam = np.eye(4)
    T_world_cam[:3, 3] = [1.5, -2e-12, -0.25]
    write_tum(tmp_path / "t.txt", Trajectory(np.array([1305031449.7996]), T_world_cam[None]))
    header, line = (tmp_path / "t.txt").read_text().splitlines()
    assert header == "# timestamp tx ty tz qx qy qz qw"
    zero = "0.000000000"
    assert (
        line
        == f"1305031449.799600 1.500000000 {zero} -0.250000000 {zero} {zero} {zero} 1.000000000"
    )


def test_reads_comments_blank_lines_commas_and_quaternions_of_any_length(tmp_path):
    (tmp_path / "t.txt").write_text(
        "# made by hand\n\n1 2 3 4 0 0 0 2\n  # more\n2,2,3,4,0,0,1,0\n"
    )
    trajectory = read_tum(tmp_path / "t.txt")
    np.testing.assert_array_equal(trajectory.timestamps_s, [1.0, 2.0])
    np.testing.assert_allclose(trajectory.T_world_cam[:, :3, 3], [[2.0, 3.0, 4.0]] * 2)
    np.testing.assert_allclose(trajectory.T_world_cam[1, :3, :3], np.diag([-1.0, -1.0, 1.0]))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("# only comments\n", "holds no poses"),
        ("# c\n1 0 0 0 0 0 0 1\n2 0 0 0 0 0 0\n", "line 3 is not .* '2 0 0 0 0 0 0'"),
        ("1 0 0 x 0 0 0 1\n", "line 1 is not .* in finite numbers: '1 0 0 x 0 0 0 1'"),
        ("1 0 0 nan 0 0 0 1\n", "line 1 is not .* in finite numbers"),
        ("1 0 0 0 0 0 0 0\n", "line 1 has a quaternion of length zero"),
        ("1 0 0 0 1e200 0 0 0\n", "line 1 has a quaternion of length 1e.200, not 1"),
        ("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "line 2 .* 1.000000 is not after .* 2.000000"),
        ("1 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n", "line 2 .* one per timestamp"),
    ],
)
def test_bad_files_are_explained_by_one_line(tmp_path, text, complaint):
    path = tmp_path / "t.txt"
    path.write_text(text)
    with pytest.raises(LoopcloseError, match=complaint) as caught:
        read_tum(path)
    assert "\n" not in str(caught.value)
    assert str(caught.value).endswith(str(path))


def test_files_that_cannot_be_read(tmp_path):
    with pytest.raises(LoopcloseError, match="No such file or directory"):
        read_tum(tmp_path / "absent.txt")
    (tmp_path / "t.txt").write_bytes(b"\x89PNG\xff")
    with pytest.raises(LoopcloseError, match="not text in UTF-8"):
        read_tum(tmp_path / "t.txt")


def test_association_uses_each_pose_once_and_the_closest_pair_first():
    a, b = at([0.0, 1.0, 1.25, 5.0]), at([0.125, 1.125, 1.25, 4.0])
    in_a, in_b = associate(a, b, tolerance_s=0.5)
    np.testing.assert_array_equal(in_a, [0, 1, 2])
    np.testing.assert_array_equal(in_b, [0, 1, 2])
    # 1.25 takes its twin; 1.0 is left with nothing within the tolerance.
    in_a, in_b = associate(at([1.0, 1.25]), at([1.25]), tolerance_s=0.5)
    np.testing.assert_array_equal(in_a, [1])
    np.testing.assert_array_equal(in_b, [0])


def test_association_tolerance_is_inclusive():
    assert len(associate(at([1.0]), at([1.25]), 0.25)[0]) == 1
    assert len(associate(at([1.0]), at([1.25]), 0.2499)[0]) == 0
    assert len(associate(at([]), at([1.25]), 0.25)[0]) == 0


stamp_lists = st.lists(st.integers(0, 60), unique=True, max_size=12).map(sorted)


@given(stamp_lists, stamp_lists, st.integers(0, 20))
def test_association_takes_what_greedy_search_takes(a, b, tolerance):
    in_a, in_b = associate(at(a), at(b), tolerance)
    gaps = sorted(abs(a[i] - b[j]) for i, j in zip(in_a, in_b, strict=True))
    assert len(set(in_a)) == len(set(in_b)) == len(gaps)
    assert all(gap <= tolerance for gap in gaps)
    assert np.all(np.diff(in_a) > 0)
    # Every pair not taken is within reach of a pair at least as close that shares a pose.
    taken_a = {i: abs(a[i] - b[j]) for i, j in zip(in_a, in_b, strict=True)}
    taken_b = {j: abs(a[i] - b[j]) for i, j in zip(in_a, in_b, strict=True)}
    for i, stamp_a in enumerate(a):
        for j, stamp_b in enumerate(b):
            gap = abs(stamp_a - stamp_b)
            if gap <= tolerance:
                assert min(taken_a.get(i, np.inf), taken_b.get(j, np.inf)) <= gap


@given(st.integers(0, 10_000), st.integers(3, 20))
def test_alignment_recovers_a_rigid_motion(seed, count):
    rng = np.random.default_rng(seed)
    points_m = rng.normal(0.0, 2.0, (count, 3))
    T_truth_world = se3.exp(rng.normal(0.0, 1.0, 6))
    recovered = align(points_m, se3.transform(T_truth_world, points_m))
    np.testing.assert_allclose(recovered, T_truth_world, atol=1e-6)


def test_alignment_is_a_rotation_where_a_reflection_would_fit_better():
    points_m = np.random.default_rng(0).normal(size=(10, 3))
    T_truth_world = align(points_m, points_m * [1.0, 1.0, -1.0])
    assert np.linalg.det(T_truth_world[:3, :3]) == pytest.approx(1.0)


@pytest.mark.parametrize(
    "points_m",
    [
        [[1.0, 2.0, 3.0]],
        [[1.0, 2.0, 3.0], [2.0, 0.0, 1.0]],
        [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [2.0, 2.0, 2.0]],
        [[1.0, 2.0, 3.0]] * 4,
        [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]],
    ],
    ids=["point", "pair", "line", "standstill", "plane"],
)
def test_alignment_of_few_or_flat_points_is_proper_and_exact(points_m):
    points_m = np.array(points_m)
    truth_m = se3.transform(se3.exp(np.array([0.3, -0.2, 1.0, 4.0, 5.0, 6.0])), points_m)
    T_truth_world = align(points_m, truth_m)
    R = T_truth_world[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    np.testing.assert_allclose(se3.transform(T_truth_world, points_m), truth_m, atol=1e-9)


def test_nothing_cannot_be_aligned():
    with pytest.raises(SlamError, match="no pose in common"):
        align(np.empty((0, 3)), np.empty((0, 3)))


def test_path_length():
    trajectory = at([0.0, 1.0, 2.0])
    trajectory.T_world_cam[:, :3, 3] = [[0.0, 0.0, 0.0], [3.0, 4.0, 0.0], [3.0, 4.0, 2.0]]
    assert path_length_m(trajectory) == 7.0
    assert path_length_m(at([0.0])) == 0.0


def test_between_two_poses_the_camera_moves_steadily():
    turn = np.array([0.2, -0.1, 0.3, 1.0, 2.0, 3.0])
    known = Trajectory(np.array([1.0, 1.02]), np.stack([se3.exp(turn), se3.exp(2 * turn)]))
    found = poses_at(known, np.array([1.0, 1.005, 1.02]), tolerance_s=0.02)
    expected = se3.exp(np.array([[1.0], [1.25], [2.0]]) * turn)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_only_poses_within_the_tolerance_say_where_the_camera_was():
    known = at([1.0, 2.0, 5.0])
    known.T_world_cam[:, 0, 3] = [1.0, 2.0, 5.0]
    found = poses_at(known, np.array([0.9, 0.95, 1.04, 1.5, 1.97, 5.05, 5.2]), tolerance_s=0.06)
    np.testing.assert_array_equal(found[:, 0, 3], [np.nan, 1.0, 1.0, np.nan, 2.0, 5.0, np.nan])
    assert np.isnan(found[0]).all()


@pytest.mark.parametrize(("known", "asked"), [(0, 2), (2, 0), (0, 0)])
def test_nothing_known_or_asked_is_no_pose(known, asked):
    found = poses_at(at(range(known)), np.full(asked, 0.5), tolerance_s=0.02)
    assert found.shape == (asked, 4, 4) and np.isnan(found).all()
