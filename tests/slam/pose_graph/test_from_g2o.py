# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import numpy as np
import pytest

from slam import SlamError, solve_g2o
from slam.geometry import se3
from slam.pose_graph import write_g2o
from slam.types import Link, RelativePose

STEP = "1 0 1.5707963 400 0 0 400 0 2500"


def planar(path: Path, *more: str) -> Path:
    """Write a square of four steps, and an edge from its beginning to its end."""
    lines = [f"EDGE_SE2 {i} {i + 1} {STEP}" for i in range(4)]
    path.write_text("\n".join([*lines, "EDGE_SE2 0 4 0.01 0 0 400 0 0 400 0 2500", *more]) + "\n")
    return path


def test_edges_that_skip_keyframes_are_loops(tmp_path):
    solution = solve_g2o(planar(tmp_path / "square.g2o"))
    assert solution.weights == {4: 1.0}
    positions = np.array([T[:3, 3] for T in solution.T_world_kf.values()])
    corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 0]]
    np.testing.assert_allclose(positions, corners, atol=0.02)


def test_a_planar_loop_is_judged_by_three_numbers(tmp_path):
    """Its squared error is 9: more than 95 % of those of three have, less than of those of six."""
    off = "EDGE_SE2 1 3 1 1.75 3.1415927 16 0 0 16 0 100"  # by three times what it is known to
    solution = solve_g2o(planar(tmp_path / "square.g2o", off))
    assert 7.8 < solution.squared_errors[5] < 12.6
    assert solution.weights[5] == 0.0


def test_three_dimensions_and_an_odometry_that_is_written_backwards(tmp_path):
    T = se3.exp(np.array([0.0, 0.1, 0.0, 1.0, 0.0, 0.2]))
    information = np.eye(6) * 1e4
    links = [
        Link(0, 1, RelativePose(T, information)),
        Link(2, 1, RelativePose(se3.inverse(T), information)),
        Link(0, 2, RelativePose(T @ T, information)),
    ]
    write_g2o(tmp_path / "graph.g2o", np.array([np.eye(4)] * 3), links)
    solution = solve_g2o(tmp_path / "graph.g2o")
    assert solution.weights == {2: 1.0}
    np.testing.assert_allclose(solution.T_world_kf[2], T @ T, atol=1e-6)


def test_a_gap_in_the_odometry_is_named(tmp_path):
    path = planar(tmp_path / "gap.g2o", f"EDGE_SE2 4 6 {STEP}")
    with pytest.raises(
        SlamError, match=r"no odometry leads to keyframe 6, an edge from 5.*gap.g2o"
    ):
        solve_g2o(path)
