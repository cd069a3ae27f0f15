# SPDX-License-Identifier: Apache-2.0
"""Recordings on disk, read as a `Sequence` of frames."""

from slam.datasets.bags import BagOdometry, read_bag_odometry
from slam.datasets.cameras import read_camera, write_camera
from slam.datasets.download import resolve
from slam.datasets.formats import open_sequence
from slam.datasets.sequence import Sequence
from slam.datasets.sessions import Sessions

__all__ = [
    "BagOdometry",
    "Sequence",
    "Sessions",
    "open_sequence",
    "read_bag_odometry",
    "read_camera",
    "resolve",
    "write_camera",
]
