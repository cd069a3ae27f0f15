# SPDX-License-Identifier: Apache-2.0
"""Saved maps that are made one, in Python and by `run_slam merge`."""

import shutil
from dataclasses import replace

import numpy as np
import pytest

from placerec.recognizers.gradients import GradientRecognizer
from slam.__main__ import main
from slam.evaluation.trajectory import read_tum
from slam.output.ledger.reading import read_ledger
from slam.output.map_folder.folder import load_map, save_map, saved_map
from slam.output.map_folder.merging import merge_maps
from slam.system import Slam
from slam.types import Camera, SlamError

OTHER_CAMERA = Camera(350, 260, 328.125, 328.125, 174.5, 129.5)
FIRST = 30
"""Frames of the first map; then the camera comes back."""


def map_of(frames, camera):
    slam = Slam(camera, GradientRecognizer())
    for frame in frames:
        slam.process(frame)
    return saved_map(slam, slam.finish())


def upside_down(frame):
    return replace(frame, rgb=frame.rgb[::-1].copy(), depth_m=frame.depth_m[::-1].copy())


@pytest.fixture(scope="module")
def place(frames, sequence, by_another_camera, tmp_path_factory):
    """Return a folder with maps of a room by two cameras, and one that shows something else."""
    folder = tmp_path_factory.mktemp("maps")
    save_map(folder / "there", map_of(frames[:FIRST:2], sequence.camera))
    save_map(folder / "back", map_of(map(by_another_camera, frames[FIRST::2]), OTHER_CAMERA))
    save_map(folder / "else", map_of(map(upside_down, frames[:6:2]), sequence.camera))
    return folder


@pytest.fixture
def maps(place):
    return {name: load(place / name) for name in ("there", "back", "else")}


def load(folder):
    return load_map(folder, GradientRecognizer())


def content(folder):
    return {
        path.relative_to(folder): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


def run(*typed):
    return main(["merge", *map(str, typed), "--recognizer", "gradients"])


def test_maps_become_one_where_loops_join_them_and_others_are_left_apart(
    place, frames, sequence, T_first_cam, tmp_path, capsys
):
    before = content(place)
    asked = [place / name for name in ("else", "there", "back")]
    # The second time without the other one, which changes nothing.
    for name, of in (("one", asked), ("again", asked[1:])):
        assert run(*of, "--out", tmp_path / name, "--poses", tmp_path / "poses") == 0
    assert content(tmp_path / "one") == content(tmp_path / "again")
    assert content(place) == before
    merged, parts = load(tmp_path / "one"), [load(each) for each in asked[1:]]
    counts = [len(each.keyframes) for each in parts]
    assert len(merged.keyframes) == sum(counts) and merged.frames.sum() == len(frames) // 2
    assert merged.sessions.tolist() == np.repeat([0, 1], counts).tolist()
    stamps_s = [frame.timestamp_s for frame in frames]
    poses = [read_tum(tmp_path / "poses" / f"session-{number}.txt") for number in (0, 1)]
    truth = T_first_cam[np.isin(stamps_s, np.concatenate([each.timestamps_s for each in poses]))]
    T_map_kf = np.concatenate([each.T_world_cam for each in poses])
    assert np.linalg.norm((T_map_kf - truth)[:, :3, 3], axis=1).max() < 0.03
    across = [each for each in merged.loops if each.ref_id < counts[0] <= each.query_id]
    (ledger,) = (tmp_path / "one").glob("arrays-*")
    records = read_ledger(ledger)
    assert len(records) >= len(across) + sum(len(each.ledger) for each in parts)
    pairs = {(each.match_id, each.query_id) for each in records if each.accepted}
    assert across and {(each.ref_id, each.query_id) for each in across} <= pairs
    told = capsys.readouterr()
    assert f"there - {place / 'back'}: {len(across)} loops, of" in told.out
    assert f"{place / 'else'} is left apart: of" in told.err
    later = Slam(sequence.camera, GradientRecognizer(), earlier=merged)
    assert later.process(frames[10]).segment == 0


def test_a_store_proposes_what_is_compared_and_the_map_is_the_same(
    place, tmp_path, capsys, needs_lancedb
):
    asked = [place / name for name in ("else", "there", "back")]
    assert run(*asked, "--out", tmp_path / "all") == 0
    told = capsys.readouterr()
    assert run(*asked, "--out", tmp_path / "one", "--store", tmp_path / "store") == 0
    assert content(tmp_path / "one") == content(tmp_path / "all")
    by_store = capsys.readouterr()
    assert "the store proposes " in by_store.out and " of 3 pairs of maps" in by_store.out
    assert told.out.replace("all", "one").splitlines() == by_store.out.splitlines()[1:]
    assert f"{place / 'else'} is left apart: " in by_store.err

    strict = tmp_path / "strict.toml"
    strict.write_text("[loop]\nmin_similarity = 0.999\n")
    asked += ["--store", tmp_path / "store", "--config", strict, "--out", tmp_path / "none"]
    assert run(*asked) == 2
    assert "by the store no two of the maps share places" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_loops_are_looked_for_between_pairs_that_were_named_alone(maps):
    with pytest.raises(SlamError, match="no loops join any two"):
        merge_maps(maps, GradientRecognizer(), pairs=[("there", "else"), ("back", "else")])
    merged = merge_maps(maps, GradientRecognizer(), pairs=[("there", "back")])
    assert merged.apart == {
        "else": "else is left apart: no keyframe of another map looks like one of it"
    }


def test_what_shares_nothing_is_not_merged(maps):
    del maps["back"]
    with pytest.raises(SlamError, match=r"no loops join .*: else is left apart: of \d+ candidates"):
        merge_maps(maps, GradientRecognizer())


def test_what_cannot_be_merged_is_told_in_one_line(place, tmp_path, capsys):
    there, back = place / "there", place / "back"
    shutil.copytree(there, tmp_path / "copy")
    shutil.copytree(back, tmp_path / "damaged")
    next((tmp_path / "damaged").glob("*/embedding.npy")).write_bytes(b"")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").touch()
    for asked, out, told in (
        ([there], "out", "needs two maps at least"),
        ([there, there], "out", "is named twice"),
        ([there, tmp_path / "copy"], "out", "has nothing to add"),
        ([there, back, "--recognizer", "bag-of-words"], "out", "by another recognizer"),
        ([there, tmp_path / "damaged"], "out", "embedding.npy of the map is missing or damaged"),
        ([there, back], "mine", "holds a letter.txt, which is of no map"),
    ):
        assert (
            main(
                [
                    "merge",
                    "--recognizer",
                    "gradients",
                    *map(str, asked),
                    "--out",
                    str(tmp_path / out),
                ]
            )
            == 2
        )
        error = capsys.readouterr().err
        assert error.count("\n") == 1 and told in error
    assert not (tmp_path / "out").exists()
