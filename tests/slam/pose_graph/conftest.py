# SPDX-License-Identifier: Apache-2.0
from dataclasses import dataclass, replace

import numpy as np
import pytest

from slam.geometry import se3
from slam.pose_graph import PoseGraph
from slam.types import FloatArray, Link, RelativePose

PER_ROUND = 40
SIGMAS = np.array([0.003, 0.003, 0.003, 0.01, 0.01, 0.01])


@dataclass
class Corridors:
    """Three rounds about a hall, seen by a noisy odometry, and loops of some of its places."""

    T_world_cam: FloatArray
    links: list[Link]
    rng: np.random.Generator
    sigmas: FloatArray

    def measured(self, ref: int, query: int, T_ref_query: FloatArray) -> Link:
        noise = se3.exp(self.rng.normal(size=6) * SIGMAS)
        return Link(ref, query, RelativePose(T_ref_query @ noise, np.diag(1.0 / SIGMAS**2)))

    def motion(self, ref: int, query: int) -> FloatArray:
        return np.asarray(se3.inverse(self.T_world_cam[ref]) @ self.T_world_cam[query])

    def true(self, first: int, count: int = 10) -> list[Link]:
        """Return loops of places that are seen again a round later."""
        pairs = [(k, k + PER_ROUND) for k in range(first, first + count)]
        return [self.measured(a, b, self.motion(a, b)) for a, b in pairs]

    def all_over(self) -> list[Link]:
        """Return true loops at three places of a round."""
        return [*self.true(0, 5), *self.true(12, 5), *self.true(25, 5)]

    def alike(self, first: int, second: int, count: int = 10) -> list[Link]:
        """Return loops that agree with each other: the way from second is taken for the first."""
        pairs = [(first + i, second + i) for i in range(count)]
        return [
            self.measured(a, b, self.motion(a, first) @ self.motion(second, b)) for a, b in pairs
        ]

    def set_information(self, k: int, information: FloatArray) -> None:
        """Say how well the odometry knows the way from a keyframe to the next."""
        link = self.links[k]
        self.links[k] = replace(link, motion=replace(link.motion, information=information))

    def graph(self, loops: list[Link]) -> PoseGraph:
        T = [np.eye(4)]
        for link in self.links:
            T.append(T[-1] @ link.motion.T_ref_query)
        return PoseGraph(dict(enumerate(T)), self.links, dict(enumerate(loops)))

    def rmse_m(self, T_world_kf: dict[int, FloatArray]) -> float:
        offs = np.array(list(T_world_kf.values()))[:, :3, 3] - self.T_world_cam[:, :3, 3]
        return float(np.sqrt((offs**2).sum(axis=1).mean()))


@pytest.fixture
def corridors():
    """Return a maker of rounds whose odometry is as many times worse than the loops.

    Its links claim so many times the errors that they have, but for what bends all of them alike,
    which is given in sigmas and not claimed.
    """

    def made(worse: float = 1.0, claimed: float = 1.0, bend: float = 0.0) -> Corridors:
        rng = np.random.default_rng(5)
        step = se3.exp(np.array([0.0, 2.0 * np.pi / PER_ROUND, 0.0, 0.5, 0.0, 0.0]))
        T, links = [np.eye(4)], []
        information = np.diag(1.0 / (claimed * worse * SIGMAS) ** 2)
        for k in range(3 * PER_ROUND - 1):
            T.append(T[-1] @ step)
            noisy = step @ se3.exp((rng.normal(size=6) + bend) * worse * SIGMAS)
            links.append(Link(k, k + 1, RelativePose(noisy, information)))
        return Corridors(np.array(T), links, rng, worse * SIGMAS)

    return made
