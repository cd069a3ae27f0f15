# SPDX-License-Identifier: Apache-2.0
from pathlib import Path

import gtsam
import numpy as np
import pytest

from placerec.errors import LoopcloseError
from slam.geometry import se3
from slam.pose_graph import read_g2o, write_g2o
from slam.types import Link, RelativePose, SlamError

EDGE = "EDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"


def random_motion(rng: np.random.Generator) -> RelativePose:
    root = rng.normal(size=(6, 6))
    return RelativePose(se3.exp(rng.normal(size=6)), root @ root.T + np.eye(6))


def test_what_is_written_is_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    poses = np.array([se3.exp(rng.normal(size=6)) for _ in range(4)])
    links = [Link(0, 1, random_motion(rng)), Link(1, 3, random_motion(rng))]
    links.append(Link(3, 2, random_motion(rng)))
    path = tmp_path / "graph.g2o"
    write_g2o(path, poses, links)

    for graph, values in (read_g2o(path), gtsam.readG2o(str(path), True)):
        for i, T_world_kf in enumerate(poses):
            np.testing.assert_allclose(values.atPose3(i).matrix(), T_world_kf, atol=1e-12)
        assert graph.size() == len(links)
        for i, link in enumerate(links):
            factor = graph.at(i)
            assert list(factor.keys()) == [link.ref_id, link.query_id]
            np.testing.assert_allclose(
                factor.measured().matrix(), link.motion.T_ref_query, atol=1e-12
            )
            np.testing.assert_allclose(
                factor.noiseModel().information(), link.motion.information, rtol=1e-9
            )


def test_keyframes_without_a_place_are_left_out(tmp_path: Path) -> None:
    motion = RelativePose(np.eye(4), np.eye(6))
    poses = np.array([np.full((4, 4), np.nan), np.eye(4), np.eye(4)])
    write_g2o(tmp_path / "graph.g2o", poses, [Link(1, 2, motion)])
    _, values = read_g2o(tmp_path / "graph.g2o")
    assert list(values.keys()) == [1, 2]


def test_translation_comes_first_in_the_file(tmp_path: Path) -> None:
    motion = RelativePose(np.eye(4), np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]))
    write_g2o(tmp_path / "graph.g2o", np.array([np.eye(4)] * 2), [Link(0, 1, motion)])
    numbers = (tmp_path / "graph.g2o").read_text().splitlines()[-1].split()[10:]
    upper = np.zeros((6, 6))
    upper[np.triu_indices(6)] = [float(each) for each in numbers]
    assert np.diag(upper).tolist() == [4.0, 5.0, 6.0, 1.0, 2.0, 3.0]


def test_a_graph_without_vertices_is_chained_from_its_edges(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text("# edges only\n\n" + EDGE + "EDGE_SE2 1 2  1 0 0  1 0 0 1 0 1\nFIX 0\n")
    graph, values = read_g2o(path)
    assert graph.size() == 2
    assert values.atPose2(2).x() == pytest.approx(2.0)


def test_edges_are_chained_in_any_order_and_against_their_direction(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text("EDGE_SE2 2 1  1 0 0.5  1 0 0 1 0 1\nEDGE_SE2 1 0  1 0 0  1 0 0 1 0 1\n")
    _, values = read_g2o(path)
    back = gtsam.Pose2(-1.0, 0.0, 0.0).compose(gtsam.Pose2(1.0, 0.0, 0.5).inverse())
    for key, expected in enumerate((gtsam.Pose2(), gtsam.Pose2(-1.0, 0.0, 0.0), back)):
        np.testing.assert_allclose(values.atPose2(key).matrix(), expected.matrix(), atol=1e-12)


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (EDGE + "EDGE_SE2 1 2 1 0 0 1 0\n", "EDGE_SE2 has 7 numbers, 11 are needed: line 2 of "),
        (
            "VERTEX_SE2 0 0 zero 0\n" + EDGE,
            "VERTEX_SE2 holds something that is not a number: line 1 of ",
        ),
        (
            EDGE.replace("1 0 1\n", "1 0 nan\n"),
            "EDGE_SE2 holds a number that is not finite: line 1 of ",
        ),
        ("\n" + EDGE.replace("0 1 1", "0 one 1"), "one is not a keyframe number: line 2 of "),
        (EDGE.replace("0 1 0 1\n", "0 1 0 -1\n"), "information matrix is not positive definite"),
        (EDGE + EDGE.replace(" 0 1", " 7 8", 1), "no edge ties 7 and 8 to the other poses"),
        ("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 0 0 0 0\n" + EDGE, "vertex 0 is there twice: line 2 of "),
        ("<html>\n", "<html> is not a tag of a pose graph"),
        (
            EDGE + "VERTEX_SE3:QUAT 5 0 0 0 0 0 0 1\n",
            "needs EDGE_SE2 or EDGE_SE3:QUAT, only one of the two",
        ),
        ("VERTEX_SE2 0 0 0 0\n", "needs EDGE_SE2 or EDGE_SE3:QUAT, only one"),
        ("", "needs EDGE_SE2 or EDGE_SE3:QUAT, only one"),
    ],
)
def test_what_is_not_g2o_is_named(tmp_path: Path, text: str, complaint: str) -> None:
    path = tmp_path / "bad.g2o"
    path.write_text(text)
    with pytest.raises(SlamError) as caught:
        read_g2o(path)
    assert complaint in str(caught.value)
    assert str(caught.value).endswith(str(path))
    assert "\n" not in str(caught.value)


def test_a_missing_or_binary_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SlamError, match="cannot read the g2o file"):
        read_g2o(tmp_path / "none.g2o")
    (tmp_path / "binary.g2o").write_bytes(b"\x80\xff\x00")
    with pytest.raises(SlamError, match="the g2o file is not text"):
        read_g2o(tmp_path / "binary.g2o")


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(LoopcloseError, match="cannot write"):
        write_g2o(tmp_path / "none" / "graph.g2o", np.eye(4)[None], [])
