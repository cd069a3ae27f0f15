# SPDX-License-Identifier: Apache-2.0
import errno
import json
import os
from dataclasses import replace

import gtsam
import numpy as np
import open3d as o3d
import pytest

from placerec.errors import LoopcloseError
from placerec.recognizers.gradients import GradientRecognizer
from slam.config import Config, EvaluationConfig, LoopConfig, MapConfig, load_config
from slam.evaluation.drift import compare_drift
from slam.evaluation.trajectory import read_tum
from slam.output import run_folder
from slam.output.ledger.reading import read_ledger
from slam.output.report import page
from slam.output.run_folder import write_run
from slam.result import MapMesh, MapMeshes
from slam.system import Slam
from slam.types import Rejection, RejectionReason, RelativePose, SlamError, Trajectory

NAMES = ("small room", "run_slam room")
MINE = ("small room", "run_slam room --recognizer mine")
IN_ORDER = [
    "trajectory.txt",
    "odometry.txt",
    "keyframes.txt",
    "groundtruth.txt",
    "loops.jsonl",
    "pose_graph.g2o",
    "settings.toml",
    "summary.json",
    "map.ply",
    "report.html",
]
CONFIG = Config(map=MapConfig(voxel_m=0.05))


@pytest.fixture(scope="module")
def result(room_run):
    return room_run


@pytest.fixture(scope="module")
def drift(result, sequence):
    return compare_drift(result, sequence.ground_truth, EvaluationConfig())


@pytest.fixture(scope="module")
def written(tmp_path_factory, result, drift, sequence):
    folder = tmp_path_factory.mktemp("run")
    write_run(folder, result, drift, sequence.ground_truth, CONFIG, *NAMES)
    return folder


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_every_file_is_there_and_nothing_else(written):
    assert names(written) == sorted(IN_ORDER)


def test_what_was_not_joined_is_in_no_file_but_the_ledger(tmp_path, frames, sequence):
    slam = Slam(sequence.camera, GradientRecognizer(), Config(loop=LoopConfig(min_similarity=-1.0)))
    for frame in [*frames[:6], *frames[24:34]]:
        slam.process(frame)
    parted = slam.finish()
    is_apart = np.isnan(parted.T_world_kf[:, 0, 0])
    assert 0 < is_apart.sum() < len(is_apart)
    drift = compare_drift(parted, sequence.ground_truth, EvaluationConfig())
    write_run(tmp_path, parted, drift, sequence.ground_truth, CONFIG, *NAMES)
    assert names(tmp_path) == sorted(IN_ORDER)
    assert len(read_tum(tmp_path / "keyframes.txt").timestamps_s) == (~is_apart).sum()
    assert len(read_tum(tmp_path / "trajectory.txt")) == 10
    _, values = gtsam.readG2o(str(tmp_path / "pose_graph.g2o"), True)
    assert sorted(values.keys()) == np.flatnonzero(~is_apart).tolist()
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["frames_tracked"], summary["frames_unjoined"]) == (10, 6)
    records = read_ledger(tmp_path / "loops.jsonl")
    assert len(records) == len(parted.attempts) > 0 and not any(each.accepted for each in records)
    assert "10 of 16" in (tmp_path / "report.html").read_text()


def test_trajectories_are_read_back(written, result, sequence):
    for name, poses in (
        ("trajectory.txt", result.trajectory.T_world_cam),
        ("odometry.txt", result.odometry.T_world_cam),
        ("keyframes.txt", result.T_world_kf),
        ("groundtruth.txt", sequence.ground_truth.T_world_cam),
    ):
        read = read_tum(written / name)
        np.testing.assert_allclose(read.T_world_cam, poses, atol=1e-7)
    times_s = [keyframe.timestamp_s for keyframe in result.keyframes]
    np.testing.assert_allclose(read_tum(written / "keyframes.txt").timestamps_s, times_s)


def lines_by_time(path):
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    return {line.split()[0]: line for line in lines}


@pytest.mark.parametrize("is_smoothed", [False, True])
def test_keyframes_are_where_the_trajectory_says(tmp_path, written, result, is_smoothed):
    folder = written
    if is_smoothed:
        T_world_cam = result.trajectory.T_world_cam.copy()
        T_world_cam[:, :3, 3] += 0.01
        there = Trajectory(result.trajectory.timestamps_s, T_world_cam)
        config = Config(map=MapConfig(write=False))
        write_run(tmp_path, replace(result, trajectory=there), None, None, config, *NAMES)
        folder = tmp_path
        graph = (folder / "pose_graph.g2o").read_text()
        assert graph == (written / "pose_graph.g2o").read_text()
    keyframes = lines_by_time(folder / "keyframes.txt")
    assert len(keyframes) == len(result.keyframes)
    assert keyframes.items() <= lines_by_time(folder / "trajectory.txt").items()


def test_gtsam_reads_the_graph_and_agrees_with_it(written, result):
    graph, values = gtsam.readG2o(str(written / "pose_graph.g2o"), True)
    kept = [each for each in result.attempts if each.weight is not None and each.weight > 0.5]
    assert values.size() == len(result.keyframes)
    assert graph.size() == len(result.links) + len(kept)
    for keyframe, T_world_kf in zip(result.keyframes, result.T_world_kf, strict=True):
        np.testing.assert_allclose(values.atPose3(keyframe.id).matrix(), T_world_kf, atol=1e-6)
    first = result.links[0]
    measured = graph.at(0).measured().matrix()
    np.testing.assert_allclose(measured, first.motion.T_ref_query, atol=1e-6)
    R = graph.at(0).noiseModel().R()
    np.testing.assert_allclose(R.T @ R, first.motion.information, rtol=1e-4)


def test_the_ledger_has_every_attempt(written, result):
    records = read_ledger(written / "loops.jsonl")
    assert [(each.query_id, each.match_id) for each in records] == [
        (each.query_id, each.match_id) for each in result.attempts
    ]


def test_the_settings_are_those_of_the_run(written):
    assert load_config(written / "settings.toml") == CONFIG


def test_the_summary_is_json_with_the_drift(written, drift):
    summary = json.loads((written / "summary.json").read_text())
    assert summary["ate_corrected_m"] == pytest.approx(drift.corrected.ate_rmse_m)
    assert summary["frames_tracked"] == 60


def test_the_map_is_a_cloud_in_colour(written):
    cloud = o3d.io.read_point_cloud(str(written / "map.ply"))
    assert len(cloud.points) > 500 and cloud.has_colors()


def test_the_report_is_one_page_with_its_title(written):
    page = (written / "report.html").read_text()
    assert page.rstrip().endswith("</html>") and "small room" in page


def test_without_truth_or_map_their_files_are_left_out(tmp_path, result):
    config = Config(map=MapConfig(write=False))
    write_run(tmp_path, result, None, None, config, *NAMES)
    assert names(tmp_path) == sorted(set(IN_ORDER) - {"groundtruth.txt", "map.ply"})
    assert json.loads((tmp_path / "summary.json").read_text())["ate_corrected_m"] is None


def test_truth_that_could_not_be_compared_is_copied_all_the_same(tmp_path, result, sequence):
    write_run(
        tmp_path, result, None, sequence.ground_truth, Config(), "small room", "run_slam room"
    )
    assert names(tmp_path) == sorted(IN_ORDER)


def test_the_same_run_gives_the_same_bytes(tmp_path, written, result, drift, sequence):
    write_run(tmp_path, result, drift, sequence.ground_truth, CONFIG, *NAMES)
    for name in IN_ORDER:
        assert (tmp_path / name).read_bytes() == (written / name).read_bytes(), name


def test_an_outvoted_loop_is_in_the_ledger_but_not_in_the_graph(tmp_path, result):
    motion = RelativePose(np.eye(4), np.eye(6))
    in_use = replace(result.attempts[-1], outcome=motion, weight=1.0)
    outvoted = Rejection(RejectionReason.OUTVOTED, 0.0, 0.5)
    loops = (in_use, replace(in_use, outcome=outvoted, weight=0.0))
    config = Config(map=MapConfig(write=False))
    write_run(tmp_path, replace(result, attempts=loops), None, None, config, "x", "run_slam x")
    assert [each.accepted for each in read_ledger(tmp_path / "loops.jsonl")] == [True, False]
    graph, _ = gtsam.readG2o(str(tmp_path / "pose_graph.g2o"), True)
    assert graph.size() == len(result.links) + 1


@pytest.mark.parametrize("stops_at", IN_ORDER)
def test_a_full_disk_leaves_the_files_before_it_whole(
    tmp_path, monkeypatch, result, drift, sequence, written, stops_at
):
    sync, writable = os.fsync, iter(IN_ORDER[: IN_ORDER.index(stops_at)])

    def fsync(stream):
        if next(writable, None) is None:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(stream)

    monkeypatch.setattr(os, "fsync", fsync)
    with pytest.raises(LoopcloseError, match=f"cannot write {stops_at}: No space left") as error:
        write_run(
            tmp_path, result, drift, sequence.ground_truth, CONFIG, "small room", "run_slam room"
        )
    assert "\n" not in str(error.value)
    complete = IN_ORDER[: IN_ORDER.index(stops_at)]
    assert names(tmp_path) == sorted(complete)
    for name in complete:
        assert (tmp_path / name).read_bytes() == (written / name).read_bytes()


def test_meshes_come_before_the_figures_that_tell_of_them(tmp_path, monkeypatch, result):
    picture = np.zeros((6, 8, 3), np.uint8)

    def made(folder, *_):
        assert (folder / "trajectory.txt").exists() and not (folder / "summary.json").exists()
        (folder / "mesh_after.ply").write_text("ply")
        return MapMeshes(None, MapMesh(-5.0, 0.01, picture, picture), 0)

    monkeypatch.setattr(run_folder, "meshes_apart", made)
    write_run(tmp_path, result, None, None, Config(map=MapConfig(write=False, mesh=True)), *NAMES)
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["mesh"] == {"before": None, "after": {"entropy": -5.0, "off_plane_m": 0.01}}
    assert "mesh_after.ply" in names(tmp_path) and sorted(summary["files"]) == names(tmp_path)


def test_meshes_that_fail_cost_a_warning_and_nothing_else(tmp_path, monkeypatch, result):
    def fail(folder, *_):
        (folder / "mesh_before.ply").write_text("half")
        raise SlamError("the process that makes them was ended by SIGKILL")

    monkeypatch.setattr(run_folder, "meshes_apart", fail)
    config = CONFIG.model_copy(update={"map": MapConfig(voxel_m=0.05, mesh=True)})
    write_run(tmp_path, result, None, None, config, *NAMES)
    assert names(tmp_path) == sorted(set(IN_ORDER) - {"groundtruth.txt"})
    summary = json.loads((tmp_path / "summary.json").read_text())
    why = "there are no meshes: the process that makes them was ended by SIGKILL"
    assert summary["mesh"] is None and summary["warnings"][-1] == why
    assert why in (tmp_path / "report.html").read_text()


def test_one_output_that_cannot_be_made_does_not_cost_the_others(tmp_path, monkeypatch, result):
    def fail(*_):
        raise MemoryError("no more")

    monkeypatch.setattr(page, "write_report", fail)
    with pytest.raises(SlamError, match=r"missing: report\.html: MemoryError: no more"):
        write_run(tmp_path, result, None, None, CONFIG, *NAMES)
    assert names(tmp_path) == sorted(set(IN_ORDER) - {"groundtruth.txt", "report.html"})


def test_what_an_earlier_run_left_is_not_mistaken_for_this_one_s(result, tmp_path):
    (tmp_path / "summary.json").write_text('{"frames_tracked": 5}')
    for name in ("map.ply", "groundtruth.txt"):
        (tmp_path / name).write_text("from an earlier run")
    config = Config(map=MapConfig(write=False))
    write_run(tmp_path, result, None, None, config, *NAMES)
    assert not (tmp_path / "map.ply").exists()
    assert not (tmp_path / "groundtruth.txt").exists()


def test_the_settings_and_the_summary_say_what_was_run(result, tmp_path):
    config = Config(map=MapConfig(write=False))
    write_run(tmp_path, result, None, None, config, *MINE)
    settings = (tmp_path / "settings.toml").read_text()
    assert settings.startswith("# run_slam room --recognizer mine --config settings.toml\n")
    assert load_config(tmp_path / "settings.toml") == config
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["command"] == MINE[1]


def test_files_that_no_run_wrote_are_left_alone(result, tmp_path):
    for name in ("map.ply", "groundtruth.txt"):
        (tmp_path / name).write_text("somebody's")
    write_run(tmp_path, result, None, None, Config(map=MapConfig(write=False)), *NAMES)
    assert (tmp_path / "map.ply").read_text() == "somebody's"
    assert (tmp_path / "groundtruth.txt").read_text() == "somebody's"


def test_a_file_added_to_an_earlier_run_is_left_alone(result, tmp_path):
    config = Config(map=MapConfig(write=False))
    write_run(tmp_path, result, None, None, config, *NAMES)
    (tmp_path / "groundtruth.txt").write_text("somebody's")
    write_run(tmp_path, result, None, None, config, *NAMES)
    assert (tmp_path / "groundtruth.txt").read_text() == "somebody's"


def test_a_file_of_somebody_s_is_not_written_over(result, tmp_path):
    (tmp_path / "trajectory.txt").write_text("somebody's")
    with pytest.raises(SlamError, match=r"holds a trajectory\.txt that is not known to be of"):
        write_run(tmp_path, result, None, None, CONFIG, *NAMES)
    assert (tmp_path / "trajectory.txt").read_text() == "somebody's"
