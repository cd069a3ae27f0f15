# SPDX-License-Identifier: Apache-2.0
"""Where parts of a robot are fixed to each other, from /tf_static and /tf."""

from collections.abc import Iterator
from typing import Any

import numpy as np

from slam.datasets.bags.bag import Bag
from slam.geometry import se3
from slam.types import FloatArray, SlamError

TRANSFORMS = "tf2_msgs/msg/TFMessage"
_SAME = 1e-6  # metres and radians: written anew, a transform may differ in its last digits

Edge = tuple[str, str]


def fixed_transform(bag: Bag, a: str, b: str) -> FloatArray | None:
    """Return the (4, 4) T_a_b between two frames of a bag, None where nothing fixed joins them.

    Fixed is what /tf_static tells, and what /tf tells and never changes.

    Raises:
        SlamError: a transform is no rotation and translation in finite numbers.
    """
    fixed = _fixed(bag)
    steps = {**fixed, **{(c, p): se3.inverse(T_p_c) for (p, c), T_p_c in fixed.items()}}
    T_a_known = {_plain(a): np.eye(4)}
    reached = list(T_a_known)
    for frame in reached:  # which grows meanwhile
        for (parent, child), T_parent_child in steps.items():
            if parent == frame and child not in T_a_known:
                T_a_known[child] = T_a_known[frame] @ T_parent_child
                reached.append(child)
    return T_a_known.get(_plain(b))


def _fixed(bag: Bag) -> dict[Edge, FloatArray]:
    """Return T_parent_child of each (parent, child) that stays as it is."""
    fixed: dict[Edge, FloatArray] = {}
    moving: set[Edge] = set()
    for edge, T_parent_child in _told(bag):
        if np.abs(fixed.setdefault(edge, T_parent_child) - T_parent_child).max() > _SAME:
            moving.add(edge)
    return {edge: T for edge, T in fixed.items() if edge not in moving}


def _told(bag: Bag) -> Iterator[tuple[Edge, FloatArray]]:
    for topic in bag.of_types(TRANSFORMS):
        for message in bag.messages(topic):
            for each in message.transforms:
                edge = _plain(each.header.frame_id), _plain(each.child_frame_id)
                motion = each.transform
                T_parent_child = rigid_of(motion.translation, motion.rotation)
                if T_parent_child is None:
                    raise SlamError(
                        f"the transform from {edge[1]} to {edge[0]} on {topic.name} is no rotation"
                        f" and translation in finite numbers: {bag.path}"
                    )
                yield edge, T_parent_child


def rigid_of(position: Any, orientation: Any) -> FloatArray | None:
    """Return the (4, 4) transform of messages of a vector, metres, and a quaternion, or None.

    A quaternion may be of any length but zero; there is none, either, where a number is not finite.
    """
    t = np.array([position.x, position.y, position.z])
    q = np.array([orientation.x, orientation.y, orientation.z, orientation.w])
    if not (np.isfinite(t).all() and np.isfinite(q).all() and q.any()):
        return None
    return se3.from_rotation_translation(se3.from_quaternion(q), t)


def _plain(frame: str) -> str:
    return frame.lstrip("/")  # as tf's first version wrote it
