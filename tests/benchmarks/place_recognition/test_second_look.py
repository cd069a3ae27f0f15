# SPDX-License-Identifier: Apache-2.0
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.place_recognition import second_look
from placerec.datasets.tum import read_tum
from slam.types import Camera, Features

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)


def _features(points_m, descriptors):
    pixels = points_m[:, :2] / points_m[:, 2:] * 525.0 + (319.5, 239.5)
    count = len(points_m)
    return Features(
        pixels=pixels,
        undistorted_px=pixels,
        octaves=np.zeros(count, np.int64),
        descriptors=descriptors,
        depth_m=points_m[:, 2],
        points_m=points_m,
    )


@pytest.fixture
def seen():
    rng = np.random.default_rng(0)
    points_m = rng.uniform((-1.0, -1.0, 1.0), (1.0, 1.0, 3.0), (60, 3))
    return points_m, rng.integers(0, 256, (60, 32), np.uint8)


def _verdict_after(moved_m, turned_rad, seen, limit=0.6):
    points_m, descriptors = seen
    R = Rotation.from_rotvec([0.0, turned_rad, 0.0])
    moved = _features(R.apply(points_m) + np.array([moved_m, 0.0, 0.0]), descriptors)
    motion = second_look._motion(_features(points_m, descriptors), moved, CAMERA)
    return second_look._verdict(motion, limit)


def test_a_motion_is_metres_plus_radians(seen):
    points_m, descriptors = seen
    R = Rotation.from_rotvec([0.0, 0.2, 0.0])
    moved = _features(R.apply(points_m) + np.array([0.3, 0.0, 0.0]), descriptors)
    motion = second_look._motion(_features(points_m, descriptors), moved, CAMERA)
    assert motion.distance == pytest.approx(0.5, abs=1e-6)
    assert motion.matches == len(points_m)


def test_the_further_the_camera_moved_the_less_alike_and_similarities_lie_between(seen):
    found = [_verdict_after(far / 2, far / 2, seen) for far in (0.0, 0.3, 0.59, 0.61, 1.2)]
    assert found == sorted(found, reverse=True)
    within, beyond = found[:3], found[3:]
    assert min(within) > 1.0  # whatever the similarity of two that no motion was found for
    assert max(beyond) < -1.0


def test_where_a_place_ends_is_told(seen):
    assert _verdict_after(0.3, 0.0, seen, limit=0.25) < -1.0 < 1.0 < _verdict_after(0.3, 0.0, seen)


def test_few_matches_bear_a_motion_out_less():
    few, many = (second_look._verdict(second_look.Motion(0.3, n), 0.6) for n in (12, 120))
    assert 1.0 < few < many
    assert second_look._verdict(second_look.Motion(0.35, 120), 0.6) > few


def test_a_fourth_of_wrong_matches_does_not_matter_and_chance_is_nothing(seen):
    points_m, descriptors = seen
    rng = np.random.default_rng(1)
    some = points_m + np.array([0.2, 0.0, 0.0])
    some[:15] = rng.uniform((-1.0, -1.0, 1.0), (1.0, 1.0, 3.0), (15, 3))
    first = _features(points_m, descriptors)
    motion = second_look._motion(first, _features(some, descriptors), CAMERA)
    assert motion.distance == pytest.approx(0.2, abs=0.02)
    assert motion.matches == pytest.approx(45, abs=3)
    mixed = _features(rng.permutation(points_m), descriptors)
    assert second_look._motion(first, mixed, CAMERA) is None
    nothing = _features(np.empty((0, 3)), np.empty((0, 32), np.uint8))
    assert second_look._motion(first, nothing, CAMERA) is None
    assert np.isnan(second_look._verdict(None, 0.6))


def test_of_two_ways_to_look_at_a_pair_the_nearer_counts(recording):
    whole = read_tum(recording)
    ends = np.isin(np.arange(len(whole)), [0, 1, len(whole) - 2, len(whole) - 1])
    dataset, alike = whole.subset(ends), np.zeros((4, 4), np.float32)
    scores, _ = second_look._look_again(alike, dataset, range(4), lambda a, b: float(a - b))
    apart = np.abs(np.subtract.outer(np.arange(4.0), np.arange(4.0)))
    assert dataset.comparable.any()
    np.testing.assert_array_equal(scores, np.where(dataset.comparable, apart, np.nan))


def test_points_that_are_known_less_well_count_less():
    rng = np.random.default_rng(3)
    points = rng.uniform((-1.0, -1.0, 1.0), (1.0, 1.0, 3.0), (40, 3))
    others = points + np.array([0.2, 0.0, 0.0])
    others[:10, 0] += 0.5
    weights = np.where(np.arange(40) < 10, 1e-6, 1.0)
    R, t = second_look._rigid(points, others, weights)
    assert np.linalg.norm(t - (0.2, 0.0, 0.0)) + R.magnitude() < 1e-3


def test_what_a_motion_tells_counts_and_else_the_similarity(recording, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["x", str(recording), "--recognizer", "gradients"])
    assert second_look.main() == 0
    embedding, _, motion = (row.split(" | ") for row in capsys.readouterr().out.splitlines()[2:5])
    assert (embedding[0], motion[0]) == ("| embedding", "| motion")
    assert float(motion[1].split()[0]) > float(embedding[1].split()[0])


def test_several_recordings_and_their_means(recording, monkeypatch, capsys):
    looks = iter([[("motion", (0.1, 0.2, 0.3, 0.4))], [("motion", (0.3, 0.6, 0.9, 0.8))]])
    monkeypatch.setattr(second_look, "_looks", lambda *_: next(looks))
    monkeypatch.setattr("sys.argv", ["x", *[str(recording)] * 2])
    assert second_look.main() == 0
    told = capsys.readouterr().out
    assert told.count(f"| {recording.name} |") == 2
    assert told.splitlines()[-1] == "| motion | 0.200 | 0.400 | 0.600 | 0.600 |"


def test_an_unknown_recording_is_named(monkeypatch, capsys, recording):
    monkeypatch.setattr("sys.argv", ["x", str(recording), "nowhere"])
    with pytest.raises(SystemExit):
        second_look.main()
    assert "no such sequence: nowhere" in capsys.readouterr().err
