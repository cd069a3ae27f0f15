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
INFORMATION = "1 0 0 0 0 0 1 0 0 0 0 1 0 0 0 1 0 0 1 0 1"
EDGE_3D = f"EDGE_SE3:QUAT 0 1 1 0 0 0 0 0 1 {INFORMATION}\n"
NO_OFFSET = "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1\n"


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
        (
            "\n" + EDGE.replace("0 1 1", "0 one 1"),
            "one is not a keyframe number, a whole one from 0 to 2^64 - 1: line 2",
        ),
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
        ("VERTEX2 0 0 0 0\n" + EDGE, "VERTEX2 is not a tag of a pose graph"),
        ("EDGE_SE3 0 1 1\n", "only one of the two; there are 1 EDGE_SE3: "),
        (EDGE.replace(" 0 1", " -1 1", 1), "-1 is not a keyframe number"),
        (EDGE.replace(" 0 1", f" {2**64} 1", 1), f"{2**64} is not a keyframe number"),
        (EDGE.replace(" 0 1", f" {'9' * 5000} 1", 1), f"{'9' * 40} is not a keyframe number"),
        (EDGE.replace(" 0 1", " 1 1", 1), "an edge ties keyframe 1 to itself: line 1 of "),
        (EDGE.replace("1 1 0", "1 1_0 0", 1), "EDGE_SE2 holds something that is not a number"),
        (EDGE.replace("1 1 0", "1 ١ 0", 1), "EDGE_SE2 holds something that is not a number"),
        (EDGE.replace("1 1 0", f"1 {'9' * 5000} 0", 1), "EDGE_SE2 holds a number that is not f"),
        (EDGE.replace("1 1 0", "1 1e200 0", 1), "EDGE_SE2 holds a number larger than 1e+50"),
        (EDGE.replace("1 0 1\n", "1 0 1e308\n"), "EDGE_SE2 holds a number larger than 1e+50"),
        (EDGE_3D.replace("0 0 0 1", "0 0 0 0", 1), "has a quaternion of length 0, 1 is needed"),
        (EDGE_3D.replace("0 0 0 1", "0 0 0 1e40", 1), "a quaternion of length 1e+40, 1 is needed"),
        (
            EDGE_3D + "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 0\n",
            "VERTEX_SE3:QUAT has a quaternion of length 0, 1 is needed: line 2 of ",
        ),
        (
            NO_OFFSET + f"EDGE_SE3_OFFSET 0 1 0 7 1 0 0 0 0 0 1 {INFORMATION}\n",
            "there is no PARAMS_SE3OFFSET 7: line 2 of ",
        ),
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


def test_what_is_no_motion_between_poses_is_left_out_with_a_line(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / "graph.g2o"
    path.write_text(
        NO_OFFSET
        + "VERTEX_TRACKXYZ -5 0 0 0\n"
        + f"EDGE_SE3_PRIOR 0 0 0 0 0 0 0 0 1 {INFORMATION}\n"
        + "EDGE_SE3_TRACKXYZ 0 -5 0 0 0 0 1 0 0 1 0 1\n" * 2
        + EDGE_3D
    )
    graph, values = read_g2o(path)
    assert (graph.size(), list(values.keys())) == (1, [0, 1])
    (record,) = caplog.records
    assert record.getMessage() == (
        "only motions between poses are read, left out are 1 EDGE_SE3_PRIOR,"
        f" 2 EDGE_SE3_TRACKXYZ, 1 VERTEX_TRACKXYZ: {path}"
    )


@pytest.mark.parametrize("text", [NO_OFFSET + EDGE_3D, "PARAMS_SE2OFFSET 0 0 0 0\n" + EDGE])
def test_offsets_without_an_edge_of_theirs_say_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, text: str
) -> None:
    (tmp_path / "graph.g2o").write_text(text + "FIX 0\n")
    assert read_g2o(tmp_path / "graph.g2o")[0].size() == 1
    assert not caplog.records


def test_edges_with_a_switch_are_edges(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "graph.g2o"
    switch = "VERTEX_SWITCH 9 1\nEDGE_SWITCH_PRIOR 9 1 1.0\n"
    loop = EDGE_3D.replace("EDGE_SE3:QUAT 0 1", "EDGE_SE3_SWITCHABLE 0 1 9")
    path.write_text(switch + loop)
    graph, values = read_g2o(path)
    assert list(graph.at(0).keys()) == [0, 1]
    assert values.atPose3(1).x() == pytest.approx(1.0)
    assert f"1 loops are read without their switches: {path}" in caplog.messages


def test_edges_between_sensors_are_read_as_of_the_bodies(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    T_world_ref, T_world_query, T_ref_a, T_query_b = se3.exp(rng.normal(size=(4, 6)))
    T_a_b = se3.inverse(T_world_ref @ T_ref_a) @ T_world_query @ T_query_b
    paths = {tag: tmp_path / f"{tag}.g2o" for tag in ("bodies", "sensors")}
    for path, motion in zip(
        paths.values(), (se3.inverse(T_world_ref) @ T_world_query, T_a_b), strict=True
    ):
        link = Link(0, 1, RelativePose(motion, random_motion(rng).information))
        write_g2o(path, np.stack([T_world_ref, T_world_query]), [link])
    text = paths["sensors"].read_text().replace("EDGE_SE3:QUAT 0 1", "EDGE_SE3_OFFSET 0 1 3 4")
    write_g2o(tmp_path / "offsets", np.stack([T_ref_a, T_query_b]), [])
    offsets = (tmp_path / "offsets").read_text()
    for i in range(2):
        offsets = offsets.replace(f"VERTEX_SE3:QUAT {i}", f"PARAMS_SE3OFFSET {3 + i}")
    paths["sensors"].write_text(text + offsets)
    direct, _ = read_g2o(paths["bodies"])
    moved, values = read_g2o(paths["sensors"])
    measured = moved.at(0).measured().matrix()
    np.testing.assert_allclose(measured, direct.at(0).measured().matrix(), atol=1e-12)
    # The error is the one that the sensors' own motion has.
    sensors = gtsam.BetweenFactorPose3(
        0, 1, gtsam.Pose3(T_a_b), gtsam.noiseModel.Gaussian.Information(link.motion.information)
    )
    off = gtsam.Values()
    off.insert(0, gtsam.Pose3(T_world_ref))
    off.insert(1, gtsam.Pose3(T_world_query @ se3.exp(1e-4 * rng.normal(size=6))))
    of_sensors = gtsam.Values()
    for key, T in enumerate((T_ref_a, T_query_b)):
        of_sensors.insert(key, off.atPose3(key).compose(gtsam.Pose3(T)))
    assert moved.error(off) == pytest.approx(sensors.error(of_sensors), rel=1e-6)
    assert values.size() == 2


def test_line_ends_comments_and_zeros_before_numbers_do_not_count(tmp_path: Path) -> None:
    path = tmp_path / "graph.g2o"
    path.write_bytes(
        b"# by hand\r\n" + EDGE.replace(" 0 1", " 007 1", 1)[:-1].encode() + b" # x\r\n"
    )
    assert list(read_g2o(path)[1].keys()) == [1, 7]
    largest = EDGE.replace(" 0 1", f" {2**64 - 1} 1", 1)
    path.write_text(largest)
    assert list(read_g2o(path)[1].keys()) == [1, 2**64 - 1]


def test_a_missing_or_binary_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SlamError, match="cannot read the g2o file"):
        read_g2o(tmp_path / "none.g2o")
    (tmp_path / "binary.g2o").write_bytes(b"\x80\xff\x00")
    with pytest.raises(SlamError, match="the g2o file is not text"):
        read_g2o(tmp_path / "binary.g2o")


def test_a_folder_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(LoopcloseError, match="cannot write"):
        write_g2o(tmp_path / "none" / "graph.g2o", np.eye(4)[None], [])
