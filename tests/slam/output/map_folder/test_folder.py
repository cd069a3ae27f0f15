# SPDX-License-Identifier: Apache-2.0
import json
import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest

from placerec.recognizers.gradients import GradientRecognizer
from slam.output.ledger.reading import read_ledger
from slam.output.map_folder import folder as map_folder
from slam.output.map_folder.folder import check_place, load_map, save_map, saved_map
from slam.types import SlamError


def content(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def inside(folder):
    (arrays,) = folder.glob("arrays-*")
    return arrays


def load(folder):
    return load_map(folder, GradientRecognizer())


class Other(GradientRecognizer):
    fingerprint = "another"


def test_what_is_loaded_is_what_was_saved(folder, finished):
    _, result = finished
    loaded = load(folder)
    assert loaded.camera == result.camera
    assert len(loaded.keyframes) == len(result.keyframes) > 5
    for k, (one, other) in enumerate(zip(loaded.keyframes, result.keyframes, strict=True)):
        assert (one.id, one.segment, one.timestamp_s) == (k, 0, other.timestamp_s)
        np.testing.assert_array_equal(one.T_odom_cam, result.T_world_kf[k])
        np.testing.assert_array_equal(one.features.descriptors, other.features.descriptors)
        np.testing.assert_array_equal(one.features.points_m, other.features.points_m)
        np.testing.assert_array_equal(one.preview.rgb, other.preview.rgb)
        np.testing.assert_array_equal(one.preview.depth_m, other.preview.depth_m)
    pairs = [(each.ref_id, each.query_id) for each in result.links]
    assert [(each.ref_id, each.query_id) for each in loaded.links] == pairs
    used = [each for each in result.attempts if each.rejection is None]
    assert [each.weight for each in loaded.attempts] == [each.weight for each in used]
    for one, other in zip(loaded.attempts, used, strict=True):
        assert one.verification.inlier_mask.sum() == other.verification.inlier_mask.sum()
    assert len(used) > 0 and loaded.frames.sum() == len(result.trajectory)
    assert len(loaded.ledger) == len(result.attempts) == len(read_ledger(inside(folder)))


def test_save_load_and_save_again_gives_the_same_bytes(folder, tmp_path):
    save_map(tmp_path / "again", load(folder))
    assert content(tmp_path / "again") == content(folder)


def test_a_map_can_be_saved_onto_itself(folder):
    before = content(folder)
    save_map(folder, load(folder))
    assert content(folder) == before


def test_every_array_is_a_npy_file_that_numpy_reads(folder):
    arrays = {path.stem: np.load(path) for path in inside(folder).glob("*.npy")}
    count = json.loads((folder / "manifest.json").read_text())["keyframes"]
    assert arrays["keyframe_T_map_cam"].shape == (count, 4, 4)
    assert arrays["feature_descriptors"].shape == (arrays["feature_count"].sum(), 32)
    first = arrays["thumbnail_color_jpeg"][: arrays["thumbnail_color_jpeg_size"][0]].tobytes()
    assert first.startswith(b"\xff\xd8") and first.endswith(b"\xff\xd9")


def test_keyframes_without_a_place_are_left_out(finished):
    slam, result = finished
    T_world_kf = result.T_world_kf.copy()
    T_world_kf[[0, 3]] = np.nan
    changed = result.__class__(**{**vars(result), "T_world_kf": T_world_kf})
    saved = saved_map(slam, changed)
    count = len(result.keyframes) - 2
    assert len(saved.keyframes) == len(saved.the_map.keyframes) == len(saved.embeddings) == count
    assert [each.id for each in saved.keyframes] == list(range(count))
    assert saved.keyframes[0].timestamp_s == result.keyframes[1].timestamp_s
    ids = {each.ref_id for each in saved.links} | {each.query_id for each in saved.links}
    assert ids <= set(range(count)) and len(saved.loops) == len(saved.attempts)
    table = saved.the_map.landmarks
    seen = saved.the_map.seen_by(range(count))
    np.testing.assert_array_equal(seen, np.flatnonzero(table.is_alive))
    assert table.observers[seen].max() < count
    assert {each.query_id for each in saved.attempts} <= set(range(count))


def damage_bytes(path):
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("name", ["feature_descriptors.npy", "loops.jsonl", "link_keyframes.npy"])
@pytest.mark.parametrize("how", [damage_bytes, os.remove])
def test_a_damaged_or_missing_file_is_told_by_its_name(folder, name, how):
    how(inside(folder) / name)
    with pytest.raises(SlamError, match=f"{name} of the map is missing or damaged"):
        load(folder)


def edited(folder, **changed):
    path = folder / "manifest.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changed))


@pytest.mark.parametrize(
    ("changed", "told"),
    [
        ({"version": 3}, "is of version 3, and this reads 2"),
        ({"format": "x"}, "no manifest of a map"),
        ({"files": {}}, "manifest of the map is damaged"),
        ({"files": {"../x.npy": {}, "loops.jsonl": {}}}, "manifest of the map is damaged"),
        ({"arrays": 3}, "manifest of the map is damaged"),
        ({"cameras": [{"width": 3}]}, "the map is damaged"),
        ({"cameras": []}, "the map is damaged"),
        ({"cameras": 3}, "manifest of the map is damaged"),
        ({"arrays": "arrays-0"}, "is missing or damaged"),
    ],
)
def test_a_manifest_of_another_kind_is_refused(folder, changed, told):
    edited(folder, **changed)
    with pytest.raises(SlamError, match=told):
        load(folder)


def test_a_map_of_version_1_which_knew_one_camera_is_read(folder):
    path, whole = folder / "manifest.json", load(folder)
    told = json.loads(path.read_text())
    (camera,) = told.pop("cameras")
    del told["files"]["keyframe_camera.npy"]
    path.write_text(json.dumps(told | {"version": 1, "camera": camera}))
    read = load(folder)
    assert [each.camera for each in read.keyframes] == [each.camera for each in whole.keyframes]
    save_map(folder, read)
    assert json.loads(path.read_text())["version"] == 2


def test_arrays_that_do_not_fit_each_other_are_refused(folder):
    files = json.loads((folder / "manifest.json").read_text())["files"]
    del files["embedding.npy"]
    edited(folder, files=files)
    with pytest.raises(SlamError, match="the map is damaged"):
        load(folder)


def test_another_recognizer_is_refused(folder):
    with pytest.raises(SlamError, match="embedded by another recognizer"):
        load_map(folder, Other())


def test_a_folder_without_a_map_is_told(tmp_path):
    with pytest.raises(SlamError, match="there is no map in this folder"):
        load(tmp_path)


def test_a_folder_that_holds_something_else_is_refused(folder, finished, tmp_path):
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    for refuse in (
        lambda: check_place(tmp_path / "mine", GradientRecognizer()),
        lambda: save_map(tmp_path / "mine", load(folder)),
    ):
        with pytest.raises(SlamError, match=r"holds a letter\.txt, which is of no map"):
            refuse()
    with pytest.raises(SlamError, match="cannot save a map here"):
        check_place(tmp_path / "mine" / "letter.txt", GradientRecognizer())
    assert content(tmp_path / "mine") == {"letter.txt": b"dear"}


def test_where_saving_fails_the_map_before_stays(folder, monkeypatch):
    before = content(folder)

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(map_folder, "write_file", full)
    with pytest.raises(SlamError, match="No space left on device"):
        save_map(folder, load(folder))
    assert content(folder) == before


# The other map is saved into each folder that is named, and killed at the n-th step that the disk
# would see: by a copy of a process that has loaded everything, which takes longest. Tells how many
# steps there were, or which signal ended them.
KILLED = """
import os, sys
from pathlib import Path
from placerec.recognizers.gradients import GradientRecognizer
from slam.output.map_folder.folder import load_map, save_map
def counted(of, name):
    step = getattr(of, name)
    def stepped(*given, **named):
        global left
        left -= 1
        if left == 0:
            os.kill(os.getpid(), 9)
        return step(*given, **named)
    setattr(of, name, stepped)
other = load_map(Path(sys.argv[1]), GradientRecognizer())
counted(os, "fsync"); counted(Path, "replace"); counted(os, "rmdir"); counted(Path, "unlink")
for asked in sys.stdin:
    most, folder = asked.rstrip().split(" ", 1)
    left = int(most)
    child = os.fork()
    if child == 0:
        try:
            save_map(Path(folder), other)
            os._exit(int(most) - left)
        finally:
            os._exit(255)
    print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
"""


def test_whoever_is_killed_leaves_the_old_map_or_the_new(folder, finished, tmp_path):
    slam, result = finished
    T_world_kf = result.T_world_kf.copy()
    T_world_kf[0] = np.nan
    other = tmp_path / "other"
    save_map(other, saved_map(slam, result.__class__(**{**vars(result), "T_world_kf": T_world_kf})))
    old, new = (len(load(each).keyframes) for each in (folder, other))
    shutil.copytree(folder, tmp_path / "copy")
    with subprocess.Popen(
        [sys.executable, "-c", KILLED, other],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as saving:

        def save(most, onto):
            print(most, onto, file=saving.stdin, flush=True)
            return int(saving.stdout.readline())

        steps = save(200, tmp_path / "copy")
        found, codes = [], []
        for most in (1, steps // 2, *range(steps - 9, steps), 200):
            codes.append(save(most, folder))
            found.append(len(load(folder).keyframes))
    assert 20 < steps < 200 and codes[0] == -signal.SIGKILL
    assert set(found) == {old, new} and found == sorted(found, reverse=True)
    assert 0 < codes[-1] < 200 and content(folder) == content(other)
