# SPDX-License-Identifier: Apache-2.0
from dataclasses import replace

import numpy as np
import pytest

from slam.evaluation.comparison import Alignment, ComparisonConfig, compare
from slam.evaluation.pose_errors import read_deltas, root_mean_square
from slam.geometry import se3
from slam.types import SlamError, Trajectory

CONFIG = ComparisonConfig()
EVO_ALIGNMENTS = {
    Alignment.SE3: {"align": True},
    Alignment.SIM3: {"align": True, "correct_scale": True},
    Alignment.ORIGIN: {"align_origin": True},
    Alignment.NONE: {},
}


def walk(count=600, seed=5):
    """A way through a room and an estimate of it, in another frame, 1.3 times as large."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(0.0, 1.0, (count, 6)) * [0.01, 0.01, 0.01, 0.004, 0.004, 0.004]
    steps += np.array([0.01, 0.02, 0.005, 0.03, 0.0, 0.01])
    T = np.eye(4)[None].repeat(count, axis=0)
    for i in range(1, count):
        T[i] = T[i - 1] @ se3.exp(steps[i])
    truth = Trajectory(1000.0 + 0.05 * np.arange(count), T)
    noise = se3.exp(rng.normal(0.0, 0.01, (count, 6)))
    T_world = se3.exp(np.array([0.4, -1.0, 0.3, 5.0, -2.0, 1.0])) @ T @ noise
    kept = np.sort(rng.choice(count, count - 100, replace=False))
    estimate = Trajectory(truth.timestamps_s[kept] + 0.004, T_world[kept])
    return estimate.enlarged(1.3), truth


def line(*places_m):
    T = np.eye(4)[None].repeat(len(places_m), axis=0)
    T[:, :3, 3] = np.array(places_m)
    return Trajectory(np.arange(len(places_m), dtype=np.float64), T)


@pytest.mark.parametrize("alignment", Alignment)
@pytest.mark.parametrize("all_pairs", [False, True], ids=["consecutive", "all pairs"])
def test_figures_are_those_of_evo(alignment, all_pairs):
    main_ape = pytest.importorskip("evo.main_ape", reason="evo, the oracle, is not installed")
    main_rpe = pytest.importorskip("evo.main_rpe")
    metrics = pytest.importorskip("evo.core.metrics")
    sync, trajectory = (pytest.importorskip(f"evo.core.{name}") for name in ("sync", "trajectory"))
    estimate, truth = walk()
    config = ComparisonConfig(alignment, 0.02, read_deltas("0.5m,2m,7f"), all_pairs)
    ours = compare(estimate, truth, config)
    how = EVO_ALIGNMENTS[alignment]

    def evo_pair():
        paths = [
            trajectory.PoseTrajectory3D(poses_se3=list(T.T_world_cam), timestamps=T.timestamps_s)
            for T in (truth, estimate)
        ]
        return sync.associate_trajectories(*paths, max_diff=0.02)

    def evo_rpe(relation, delta):
        unit = metrics.Unit.frames if delta.unit == "f" else metrics.Unit.meters
        asked = {"delta": delta.amount, "delta_unit": unit, "all_pairs": all_pairs}
        return main_rpe.rpe(*evo_pair(), relation, **asked, **how).np_arrays["error_array"]

    relations = metrics.PoseRelation.translation_part, metrics.PoseRelation.rotation_angle_deg
    for relation, errors in zip(relations, (ours.ape_m, ours.ape_deg), strict=True):
        theirs = main_ape.ape(*evo_pair(), relation, **how).np_arrays["error_array"]
        np.testing.assert_allclose(errors, theirs, atol=1e-6, rtol=0.0)
    for each in ours.rpe:
        for relation, errors in zip(
            relations, (each.translation_m, each.rotation_deg), strict=True
        ):
            assert len(errors) > 5
            np.testing.assert_allclose(errors, evo_rpe(relation, each.delta), atol=1e-6, rtol=0.0)


def test_what_was_compared_and_what_is_missing_is_told():
    _, truth = walk()
    kept = np.r_[20:200, 300:600]  # from 1 s on, with a gap of 5 s
    late = Trajectory(np.append(truth.timestamps_s[kept] + 0.003, 1100.0), np.eye(4)[None])
    late = replace(late, T_world_cam=np.concatenate([truth.T_world_cam[kept], np.eye(4)[None]]))
    found = compare(late, truth, CONFIG).association
    assert (found.matched, found.estimate_poses, found.truth_poses) == (480, 481, 600)
    assert found.most_apart_s == pytest.approx(0.003)
    np.testing.assert_allclose(found.missing_s, [[1000.0, 1001.003], [1009.953, 1015.003]])
    assert found.estimate_covers == pytest.approx(1.0 - (1.003 + 5.05) / 29.95)
    assert found.truth_covers == pytest.approx((1029.95 - 1001.003) / (1100.0 - 1001.003))


def test_a_scale_is_only_adjusted_where_that_is_asked_for():
    estimate, truth = walk()
    rigid = compare(estimate, truth, CONFIG)
    similar = compare(estimate, truth, replace(CONFIG, alignment=Alignment.SIM3))
    assert rigid.scale == 1.0 and similar.scale == similar.best_scale == rigid.best_scale
    assert similar.scale == pytest.approx(1.0 / 1.3, abs=2e-3)
    assert root_mean_square(similar.ape_m) < 0.1 * root_mean_square(rigid.ape_m)


@pytest.mark.parametrize(
    ("places_m", "said"),
    [
        ([(0, 0, 0), (1, 1, 0), (2, 2, 0), (3, 3, 0)], "on a line"),
        ([(1, 2, 3)] * 4, "in one place"),
    ],
)
def test_an_alignment_that_leaves_a_rotation_open_says_so(places_m, said):
    truth = line(*places_m)
    found = compare(truth, truth, CONFIG)
    assert said in found.undetermined and len(found.ape_deg) == 0
    np.testing.assert_allclose(found.ape_m, 0.0, atol=1e-12)
    by_origin = compare(truth, truth, replace(CONFIG, alignment=Alignment.ORIGIN))
    assert by_origin.undetermined == "" and len(by_origin.ape_deg) == 4


def test_a_corner_fixes_an_alignment():
    corner = line((0, 0, 0), (1, 0, 0), (1, 1, 0))
    assert compare(corner, corner, CONFIG).undetermined == ""


def test_two_poses_can_be_compared_but_not_aligned():
    two = line((0, 0, 0), (1, 0, 0))
    with pytest.raises(SlamError, match=r"only 2 of 2 .*, 3 are needed for the alignment se3"):
        compare(two, two, CONFIG)
    found = compare(two, two, replace(CONFIG, alignment=Alignment.NONE))
    assert found.ape_m.tolist() == [0.0, 0.0]
    assert [len(each.translation_m) for each in found.rpe] == [1, 1]


def test_no_scale_is_found_for_what_stays_in_one_place():
    corner = line((0, 0, 0), (1, 0, 0), (1, 1, 0))
    with pytest.raises(SlamError, match="no scale to be found"):
        compare(line(*[(0, 0, 0)] * 3), corner, replace(CONFIG, alignment=Alignment.SIM3))


def test_other_clocks_are_named_by_their_gap():
    truth = line((0, 0, 0), (1, 0, 0), (1, 1, 0))
    late = Trajectory(truth.timestamps_s + 40.0, truth.T_world_cam)
    with pytest.raises(SlamError, match=r"only 0 of 3 .* closest gap is 38 s, 0.02 s are allowed"):
        compare(late, truth, CONFIG)


def test_rows_belong_together_where_there_are_as_many():
    corner = line((0, 0, 0), (1, 0, 0), (1, 1, 0))
    far = Trajectory(corner.timestamps_s + 40.0, corner.T_world_cam)
    found = compare(far, corner, CONFIG, by_row=True)
    assert found.association.matched == 3 and np.isnan(found.association.most_apart_s)
    with pytest.raises(SlamError, match="3 of the estimate and 2 of the truth"):
        compare(corner, line((0, 0, 0), (1, 0, 0)), CONFIG, by_row=True)


def test_errors_by_length_are_over_a_series_up_to_half_of_the_way():
    estimate, truth = walk()
    found = compare(estimate, truth, CONFIG)
    lengths_m = [each.delta.amount for each in found.by_length]
    assert lengths_m[-3:] == [2.0, 5.0, 10.0] or lengths_m[-2:] == [2.0, 5.0]
    assert lengths_m[-1] <= 0.5 * found.association.truth_length_m < 2.5 * lengths_m[-1]
    assert len(lengths_m) == 8


@pytest.mark.parametrize("all_pairs", [False, True], ids=["consecutive", "all pairs"])
def test_the_break_between_two_recordings_is_no_gap_and_no_pair_leads_across_it(all_pairs):
    _, truth = walk()
    later = truth.timestamps_s + np.where(np.arange(600) < 200, 0.0, 300.0)
    truth = Trajectory(later - 0.001, truth.T_world_cam)
    kept = np.r_[0:190, 200:600]  # the truth goes on after the first recording
    estimate = Trajectory(later[kept], truth.T_world_cam[kept])
    config = replace(CONFIG, deltas=read_deltas("0.5m,7f"), all_pairs=all_pairs)
    found = compare(estimate, truth, config, session_starts_s=[later[200]])
    parts = [
        compare(Trajectory(estimate.timestamps_s[rows], estimate.T_world_cam[rows]), truth, config)
        for rows in (slice(0, 190), slice(190, None))
    ]
    for i, errors in enumerate(found.rpe):
        expected = np.concatenate([each.rpe[i].translation_m for each in parts])
        np.testing.assert_allclose(errors.translation_m, expected, atol=1e-9)
    of = found.association
    assert len(of.missing_s) == 0 and of.span_s < 30.0
    assert of.truth_covers > 0.99 and of.estimate_covers > 0.99
    ways_m = sum(each.association.truth_length_m for each in parts)
    assert of.truth_length_m == pytest.approx(ways_m)


def test_where_there_are_no_times_poses_are_numbered():
    corner = line((0, 0, 0), (1, 0, 0), (1, 1, 0))
    late = Trajectory(1e9 + 0.1 * corner.timestamps_s, corner.T_world_cam)
    assert compare(late, corner, CONFIG, by_row=True).times_s.tolist() == [0.0, 1.0, 2.0]
