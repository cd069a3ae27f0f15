# SPDX-License-Identifier: Apache-2.0
from types import SimpleNamespace

import numpy as np

from slam.evaluation.leave_one_out import helped_m
from slam.types import Influence, Trajectory

COUNT = 8


def trajectory(positions_m):
    T = np.tile(np.eye(4), (len(positions_m), 1, 1))
    T[:, :3, 3] = positions_m
    return Trajectory(np.arange(len(positions_m), dtype=float), T)


def test_a_loop_helped_if_the_error_is_larger_without_it():
    true_m = np.random.default_rng(0).uniform(-1, 1, (COUNT, 3))
    bend_m = np.zeros((COUNT, 3), np.float32)
    bend_m[4, 1] = 0.2
    ids = np.arange(COUNT)
    attempts = [
        SimpleNamespace(influence=None),
        SimpleNamespace(influence=Influence(ids, -bend_m, 3.0)),  # took half of a bend away
        SimpleNamespace(influence=Influence(ids[4:5], bend_m[4:5], 30.0)),  # put a bend in
        SimpleNamespace(influence=Influence(ids, np.ones_like(bend_m), 1.0)),  # moved all alike
    ]
    truth = trajectory(true_m)
    estimate = trajectory(true_m + bend_m)
    result = SimpleNamespace(
        earlier=0,
        attempts=attempts,
        keyframes=[SimpleNamespace(timestamp_s=t) for t in estimate.timestamps_s],
        T_world_kf=estimate.T_world_cam,
    )
    none, helped, hurt, neither = helped_m(result, truth, 0.02)
    assert np.isnan(none) and helped > 0.01 and hurt < -0.01 and abs(neither) < 1e-9
    few = Trajectory(truth.timestamps_s[:2], truth.T_world_cam[:2])
    assert np.isnan(helped_m(result, few, 0.02)).all()
