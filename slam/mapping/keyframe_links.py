# SPDX-License-Identifier: Apache-2.0
"""The motions between keyframes of the map, as the landmarks that both see hold them."""

from collections.abc import Sequence

import numpy as np

from slam.geometry import se3
from slam.geometry.motion_noise import link_noise, loop_noise, typical_depth_m
from slam.geometry.reprojection import robust_weights
from slam.mapping.bundle_equations import inverses
from slam.mapping.landmark_map import LandmarkMap
from slam.types import FloatArray, IntArray, Keyframe, Link, RelativePose

_MIN_SHARED = 10  # landmarks; fewer do not hold a motion in all directions
_NO_DEPTH = 1e-3  # of information, m^-2: along a ray that no depth was measured on


def covisible_links(
    the_map: LandmarkMap, new: Keyframe, covisible: Sequence[Keyframe], hessian: FloatArray
) -> tuple[Link, ...]:
    """Return the motions of a new keyframe to others, which share most with it first.

    At least one is returned: where none of them sees enough, the new keyframe was placed by
    landmarks of several, and the (6, 6) Hessian of its pose has to do.
    """

    def link(ref: Keyframe, motion: RelativePose) -> Link:
        depth_m = typical_depth_m(ref.features, new.features)
        turning = (ref.turning_rad_s, new.turning_rad_s)
        # Another camera's model leaves out other things.
        is_same = ref.camera in (None, the_map.camera)
        with_noise = link_noise if is_same else loop_noise
        return Link(ref.id, new.id, with_noise(motion, the_map.camera, depth_m, *turning))

    motions = [(ref, motion_between(the_map, ref.id, new.id)) for ref in covisible]
    links = tuple(link(ref, motion) for ref, motion in motions if motion)
    if links:
        return links
    T_map_ref, T_map_new = (the_map.keyframes[k.id].T_map_cam for k in (covisible[0], new))
    return (link(covisible[0], RelativePose(se3.inverse(T_map_ref) @ T_map_new, hessian)),)


def motion_between(the_map: LandmarkMap, ref_id: int, query_id: int) -> RelativePose | None:
    """Return the motion between two keyframes where the map has them; None if they share little.

    Its information is what remains of both keyframes' measurements once the landmarks are
    marginalised: a landmark whose place in the world two cameras know with (3, 3) information A and
    B ties them to each other with `(A^-1 + B^-1)^-1`.
    """
    pairs = the_map.shared_features(ref_id, query_id)
    if len(pairs) < _MIN_SHARED:
        return None
    query = the_map.keyframes[query_id]
    ids = the_map.landmarks.resolve(query.landmark_of[pairs[:, 1]])
    by_ref = _point_information(the_map, ref_id, pairs[:, 0], ids)
    by_query = _point_information(the_map, query_id, pairs[:, 1], ids)
    tie = by_ref @ inverses(by_ref + by_query + _NO_DEPTH * np.eye(3)) @ by_query
    R_map_query = query.T_map_cam[:3, :3]
    tie = R_map_query.T @ (0.5 * (tie + tie.transpose(0, 2, 1))) @ R_map_query
    T_query_map = se3.inverse(query.T_map_cam)
    points_m = se3.transform(T_query_map, the_map.landmarks.positions_m[ids])
    # p_ref = T_ref_query exp(xi) p_query: d p = omega x p_query + v, in the query's axes
    J = np.concatenate([-se3.skew(points_m), np.tile(np.eye(3), (len(ids), 1, 1))], axis=2)
    information = np.einsum("nia,nij,njb->ab", J, tie, J, optimize=True)
    T_ref_query = se3.inverse(the_map.keyframes[ref_id].T_map_cam) @ query.T_map_cam
    return RelativePose(T_ref_query, np.asarray(information))


def _point_information(
    the_map: LandmarkMap, keyframe_id: int, features: IntArray, ids: IntArray
) -> FloatArray:
    """Return (N, 3, 3), what a keyframe's features say of where their landmarks are, map axes."""
    keyframe = the_map.keyframes[keyframe_id]
    points_m = se3.transform(se3.inverse(keyframe.T_map_cam), the_map.landmarks.positions_m[ids])
    measured = the_map.measured(keyframe_id).select(features)
    residuals, by_point = measured.residuals(points_m, the_map.camera)
    J = np.sqrt(robust_weights(residuals))[:, :, None] * by_point @ keyframe.T_map_cam[:3, :3].T
    return np.asarray(J.transpose(0, 2, 1) @ J)
