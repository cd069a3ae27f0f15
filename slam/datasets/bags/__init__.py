# SPDX-License-Identifier: Apache-2.0
"""Recordings in ROS 1 bags, ROS 2 bags and MCAP files."""

from slam.datasets.bags.bag import is_bag
from slam.datasets.bags.odometry import BagOdometry, read_bag_odometry
from slam.datasets.bags.recording import open_bag

__all__ = ["BagOdometry", "is_bag", "open_bag", "read_bag_odometry"]
