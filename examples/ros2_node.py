# SPDX-License-Identifier: Apache-2.0
"""A ROS 2 node that closes loops for a robot's odometry: it sends the transform map -> odom.

    source /opt/ros/DISTRIBUTION/setup.bash
    python examples/ros2_node.py --ros-args -r color:=/camera/color/image_raw \
        -r depth:=/camera/aligned_depth_to_color/image_raw \
        -r camera_info:=/camera/color/camera_info -r odometry:=/odom

It listens to colour, depth that is registered to it, the colour camera's calibration and
nav_msgs/Odometry; where the camera is on the robot it asks tf. It sends map -> odom with every
image, and the keyframes with the links between them as markers on `pose_graph`; loops are drawn
when it ends (Ctrl-C). Whoever sends odom -> base_link goes on doing so.

The Python that ROS 2 came with must have loopclose installed. Only `main` needs ROS; everything
else takes any objects with the fields of its messages. The covariance of an Odometry message is not
used: it is that of the whole way, not of a step, and what it is worth is found out from the images.
"""

import sys
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from placerec import load
from slam import Camera, Config, Frame, LoopcloseError, Slam, SlamError, SlamResult, TrackedFrame

Array = NDArray[np.float64]

FARTHEST_APART_S = 0.02  # a colour image and its depth
LONGEST_GAP_S = 0.5  # between two poses around an image, and that an image waits for a pose
KEPT = 200  # images or poses that wait for the others; a node that is too slow loses the oldest

COLOURS = {"rgb8": (0, 1, 2), "rgba8": (0, 1, 2), "bgr8": (2, 1, 0), "bgra8": (2, 1, 0)}
DEPTHS: dict[str, type[np.generic]] = {"16UC1": np.uint16, "mono16": np.uint16, "32FC1": np.float32}
MAP = "map"
LENSES = "plumb_bob", "rational_polynomial"
LINE_LIST, POINTS = 5, 8  # of visualization_msgs/Marker


def seconds(stamp: Any) -> float:
    """Return the time of a header."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def pixels(message: Any, kind: type[np.generic], channels: int) -> NDArray[Any]:
    """Return an image message as (H, W, channels)."""
    order = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(message.data, np.uint8).reshape(message.height, message.step)
    used = np.ascontiguousarray(rows[:, : message.width * channels * order.itemsize])
    return used.view(order).reshape(message.height, message.width, channels)


def colour(message: Any) -> NDArray[np.uint8]:
    """Return an image message as (H, W, 3) RGB.

    Raises:
        SlamError: it is in an encoding that is not read here.
    """
    if message.encoding not in COLOURS:
        raise SlamError(f"colour must be one of {', '.join(COLOURS)}, not {message.encoding!r}")
    return np.array(
        pixels(message, np.uint8, len(message.encoding) - 1)[..., COLOURS[message.encoding]]
    )


def depth_m(message: Any) -> NDArray[np.float32]:
    """Return a depth message as (H, W), metres, 0 where unknown; whole numbers are millimetres.

    Raises:
        SlamError: it is in an encoding that is not read here.
    """
    if message.encoding not in DEPTHS:
        raise SlamError(f"depth must be one of {', '.join(DEPTHS)}, not {message.encoding!r}")
    depth = pixels(message, DEPTHS[message.encoding], 1)[..., 0].astype(np.float32)
    if message.encoding != "32FC1":
        depth *= np.float32(0.001)
    return np.where(np.isfinite(depth) & (depth > 0.0), depth, np.float32(0.0))


def camera(info: Any) -> Camera:
    """Return the camera of a CameraInfo message, of images that are not rectified.

    Raises:
        SlamError: it is not calibrated, or its lens has more than five coefficients.
    """
    if not info.k[0] > 0.0:
        raise SlamError("camera_info says that the camera is not calibrated")
    if any(info.d) and (any(info.d[5:]) or info.distortion_model not in LENSES):
        raise SlamError(
            f"the lens model {info.distortion_model!r} is not known here; send rectified images"
        )
    k1, k2, p1, p2, k3 = (*map(float, info.d[:5]), *[0.0] * 5)[:5]
    fx, cx, fy, cy = (float(info.k[i]) for i in (0, 2, 4, 5))
    return Camera(info.width, info.height, fx, fy, cx, cy, (k1, k2, p1, p2, k3), depth_scale=1000.0)


def matrix(position: Any, orientation: Any) -> Array:
    """Return the (4, 4) transform of a message's position, or translation, and quaternion."""
    q = orientation
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([q.x, q.y, q.z, q.w]).as_matrix()
    T[:3, 3] = position.x, position.y, position.z
    return T


def fill_transform(transform: Any, T: Array) -> None:
    """Write a (4, 4) transform into the fields of a geometry_msgs/Transform."""
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    for part, names, values in (
        (transform.translation, "xyz", T[:3, 3]),
        (transform.rotation, "xyzw", quaternion),
    ):
        for name, value in zip(names, values.tolist(), strict=True):
            setattr(part, name, value)


class Pairing:
    """Puts colour, depth and the odometry's pose of one time together, whatever order they have."""

    def __init__(self) -> None:
        self._colours: deque[tuple[float, Any]] = deque(maxlen=KEPT)
        self._depths: deque[tuple[float, Any]] = deque(maxlen=KEPT)
        self._poses: deque[tuple[float, Array]] = deque(maxlen=KEPT)

    def add_colour(self, message: Any) -> None:
        """Take a colour image."""
        self._colours.append((seconds(message.header.stamp), message))

    def add_depth(self, message: Any) -> None:
        """Take a depth image."""
        self._depths.append((seconds(message.header.stamp), message))

    def add_pose(self, message: Any) -> None:
        """Take a nav_msgs/Odometry; one that is not later than the one before is left out."""
        time_s = seconds(message.header.stamp)
        if not self._poses or time_s > self._poses[-1][0]:
            pose = message.pose.pose
            self._poses.append((time_s, matrix(pose.position, pose.orientation)))

    def next(self) -> tuple[float, Any, Any, Array | None] | None:
        """Return time, colour, depth and pose of the next image, None while something is missing.

        The depth is the nearest in time. There is no pose where the odometry has a gap. Images
        before its first pose are left out, as are those without depth.
        """
        while self._colours and self._poses:
            time_s, message = self._colours[0]
            waits_s = self._colours[-1][0] - time_s
            is_early = time_s < self._poses[0][0]
            last_s = min(self._poses[-1][0], self._depths[-1][0] if self._depths else -np.inf)
            if not is_early and last_s < time_s and waits_s <= LONGEST_GAP_S:
                return None
            self._colours.popleft()
            depth = None if is_early else self._depth(time_s)
            if depth is not None:
                return time_s, message, depth, self._pose(time_s)
        return None

    def _depth(self, time_s: float) -> Any | None:
        if not self._depths:
            return None
        nearest_s, depth = min(self._depths, key=lambda each: abs(each[0] - time_s))
        if abs(nearest_s - time_s) > FARTHEST_APART_S:
            return None
        while self._depths[0][0] <= nearest_s:
            self._depths.popleft()
            if not self._depths:
                break
        return depth

    def _pose(self, time_s: float) -> Array | None:
        while len(self._poses) > 1 and self._poses[1][0] <= time_s:
            self._poses.popleft()
        before_s, T_before = self._poses[0]
        if before_s == time_s:
            return T_before
        if len(self._poses) < 2 or self._poses[1][0] - before_s > LONGEST_GAP_S:
            return None
        after_s, T_after = self._poses[1]
        share = (time_s - before_s) / (after_s - before_s)
        ends = Rotation.from_matrix(np.stack([T_before[:3, :3], T_after[:3, :3]]))
        T = np.eye(4)
        T[:3, :3] = Slerp([0.0, 1.0], ends)(share).as_matrix()
        T[:3, 3] = (1.0 - share) * T_before[:3, 3] + share * T_after[:3, 3]
        return T


@dataclass(frozen=True)
class Drawing:
    """The pose graph in the map, metres: (K, 3) keyframes, and (N, 2, 3) ends of lines."""

    keyframes: Array
    links: Array
    loops: Array


@dataclass(frozen=True)
class Update:
    """What is to be sent after an image; None is what is not known, or has not changed."""

    T_map_odom: Array | None
    drawing: Drawing | None


class Mapper:
    """Hands what was paired to `Slam`, and says what to send."""

    def __init__(self, camera: Camera, T_base_cam: Array, recognizer: str = "learned") -> None:
        quaternion = Rotation.from_matrix(T_base_cam[:3, :3]).as_quat()
        mount = (*T_base_cam[:3, 3].tolist(), *quaternion.tolist())
        config = Config.model_validate({"odometry": {"T_base_cam": mount}})
        self._slam = Slam(camera, load(recognizer), config)
        self._T_base_cam = T_base_cam
        self._T_map_world: Array | None = None
        self._links: list[tuple[int, int]] = []
        self._drawn = -1

    def take(self, frame: Frame, T_odom_base: Array | None) -> Update:
        """Take the next image and the pose of the robot then.

        Raises:
            SlamError: the image is not the camera's, or not later than the one before.
        """
        tracked = self._slam.process(frame, T_odom_base)
        if isinstance(tracked, TrackedFrame) and tracked.new_keyframe:
            if self._T_map_world is None and T_odom_base is not None:
                self._T_map_world = T_odom_base @ self._T_base_cam
            self._links += [(each.ref_id, each.query_id) for each in tracked.links]
        try:
            T_map_odom = self._slam.T_map_odom()
        except SlamError:  # not known yet: no keyframe, or lost
            return Update(None, None)
        correction, drawing = self._slam.correction, None
        if correction.version > self._drawn and self._T_map_world is not None:
            self._drawn = correction.version
            drawing = self._draw(correction.T_world_kf, ())
        return Update(T_map_odom, drawing)

    def finish(self) -> tuple[SlamResult, Drawing]:
        """Return what the run found out, and the pose graph in the end, loops included.

        Raises:
            SlamError: no image could be tracked.
        """
        result = self._slam.finish()
        poses = enumerate(self._slam.correction.T_world_start @ result.T_world_kf)
        T_world_kf = {k: T for k, T in poses if np.isfinite(T[0, 0])}
        used = [each for each in result.attempts if each.rejection is None]
        return result, self._draw(T_world_kf, [(each.match_id, each.query_id) for each in used])

    def _draw(self, T_world_kf: Mapping[int, Array], loops: Iterable[tuple[int, int]]) -> Drawing:
        T_map_world = np.eye(4) if self._T_map_world is None else self._T_map_world
        at = {k: (T_map_world @ T)[:3, 3] for k, T in T_world_kf.items()}
        links, lines = (
            np.array([(at[a], at[b]) for a, b in pairs if a in at and b in at]).reshape(-1, 2, 3)
            for pairs in (self._links, loops)
        )
        return Drawing(np.array(list(at.values())).reshape(-1, 3), links, lines)


def markers(drawing: Drawing, marker: Callable[[], Any], point: Callable[[], Any]) -> list[Any]:
    """Return a visualization_msgs/Marker each for keyframes, links and loops, in the map."""
    looks = (
        (drawing.keyframes, POINTS, 0.04, (0.1, 0.3, 0.9)),
        (drawing.links.reshape(-1, 3), LINE_LIST, 0.01, (0.6, 0.6, 0.6)),
        (drawing.loops.reshape(-1, 3), LINE_LIST, 0.01, (0.9, 0.2, 0.1)),
    )
    made = []
    for number, (ends, kind, width_m, rgb) in enumerate(looks):
        each = marker()
        each.header.frame_id = MAP
        each.ns, each.id, each.type, each.action = "pose_graph", number, kind, 0
        each.pose.orientation.w = 1.0
        each.scale.x = each.scale.y = width_m
        each.color.r, each.color.g, each.color.b, each.color.a = *rgb, 1.0
        for x, y, z in ends.tolist():
            p = point()
            p.x, p.y, p.z = x, y, z
            each.points.append(p)
        made.append(each)
    return made


class Loopclose:
    """What the node does with its messages; how it asks tf and how it sends are given to it.

    Args:
        mount: returns the (4, 4) T_base_cam of two frames' names, None while tf does not know it.
        send: takes the image's header, the odometry's frame and what is to be sent.
    """

    def __init__(
        self,
        mount: Callable[[str, str], Array | None],
        send: Callable[[Any, str, Update], None],
    ) -> None:
        self._mount, self._send = mount, send
        self._pairing = Pairing()
        self._info: Any = None
        self._frames: tuple[str, str] | None = None  # the odometry's, and its body's
        self.mapper: Mapper | None = None

    def on_info(self, message: Any) -> None:
        """Take the colour camera's calibration; the first one counts."""
        self._info = self._info or message

    def on_odometry(self, message: Any) -> None:
        """Take a pose of the robot."""
        self._frames = message.header.frame_id, message.child_frame_id
        self._pairing.add_pose(message)
        self._go_on()

    def on_colour(self, message: Any) -> None:
        """Take a colour image."""
        self._pairing.add_colour(message)
        self._go_on()

    def on_depth(self, message: Any) -> None:
        """Take a depth image, which shows the same pixel by pixel."""
        self._pairing.add_depth(message)
        self._go_on()

    def _go_on(self) -> None:
        if self._info is None or self._frames is None:
            return
        while (ready := self._pairing.next()) is not None:
            time_s, image, depth, T_odom_base = ready
            odom, base = self._frames
            if self.mapper is None:
                T_base_cam = self._mount(base, image.header.frame_id)
                if T_base_cam is None or T_odom_base is None:
                    continue  # the map begins where the odometry has the first image
                self.mapper = Mapper(camera(self._info), T_base_cam)
            frame = Frame(time_s, colour(image), depth_m(depth))
            self._send(image.header, odom, self.mapper.take(frame, T_odom_base))


class Ros:
    """Asks tf and sends, by the modules of ROS that are given to it."""

    def __init__(
        self, node: Any, tf2_ros: Any, now: Any, geometry: Any, visualization: Any
    ) -> None:
        self._node, self._tf2_ros, self._now = node, tf2_ros, now
        self._geometry, self._visualization = geometry, visualization
        self._buffer = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._buffer, node)
        self._broadcaster = tf2_ros.TransformBroadcaster(node)
        self._graph = node.create_publisher(visualization.MarkerArray, "pose_graph", 1)

    def mount(self, base: str, of_camera: str) -> Array | None:
        """Return the (4, 4) transform from the camera to the base, None while it is not known."""
        try:
            found = self._buffer.lookup_transform(base, of_camera, self._now).transform
        except self._tf2_ros.TransformException as error:
            self._node.get_logger().warning(f"waiting for tf: {error}", throttle_duration_sec=2.0)
            return None
        return matrix(found.translation, found.rotation)

    def send(self, header: Any, odom: str, update: Update) -> None:
        """Send map -> odom, and the pose graph, as far as there is something to send."""
        if update.T_map_odom is not None:
            message = self._geometry.TransformStamped()
            message.header.stamp, message.header.frame_id = header.stamp, MAP
            message.child_frame_id = odom
            fill_transform(message.transform, update.T_map_odom)
            self._broadcaster.sendTransform(message)
        if update.drawing is not None:
            self.draw(update.drawing)

    def draw(self, drawing: Drawing) -> None:
        """Send the pose graph."""
        message = self._visualization.MarkerArray()
        message.markers = markers(drawing, self._visualization.Marker, self._geometry.Point)
        self._graph.publish(message)


def main(arguments: list[str] | None = None) -> None:
    """Run the node until Ctrl-C.

    Raises:
        SlamError: there is no ROS 2, or an image cannot be used.
    """
    try:
        import geometry_msgs.msg
        import nav_msgs.msg
        import rclpy
        import rclpy.qos
        import rclpy.signals
        import rclpy.time
        import sensor_msgs.msg
        import tf2_ros
        import visualization_msgs.msg
    except ImportError as error:
        raise SlamError(
            f"there is no ROS 2 here, {error.name} is missing: source the setup.bash of its"
            " installation, and run the node with the Python that it came with"
        ) from error
    # ROS does not handle Ctrl-C, so that the loops can still be sent after it.
    rclpy.init(args=arguments, signal_handler_options=rclpy.signals.SignalHandlerOptions.NO)
    node = rclpy.create_node("loopclose")
    ros = Ros(node, tf2_ros, rclpy.time.Time(), geometry_msgs.msg, visualization_msgs.msg)
    loopclose, camera_qos = Loopclose(ros.mount, ros.send), rclpy.qos.qos_profile_sensor_data
    for kind, topic, callback, qos in (
        (sensor_msgs.msg.CameraInfo, "camera_info", loopclose.on_info, camera_qos),
        (sensor_msgs.msg.Image, "color", loopclose.on_colour, camera_qos),
        (sensor_msgs.msg.Image, "depth", loopclose.on_depth, camera_qos),
        (nav_msgs.msg.Odometry, "odometry", loopclose.on_odometry, KEPT),
    ):
        node.create_subscription(kind, topic, callback, qos)
    with suppress(KeyboardInterrupt):
        rclpy.spin(node)
    if loopclose.mapper is not None:
        result, drawing = loopclose.mapper.finish()
        ros.draw(drawing)
        print(f"{len(result.keyframes)} keyframes, {len(drawing.loops)} loops closed")
        print(*[result.given.verdict] if result.given else [], *result.warnings, sep="\n")
    rclpy.shutdown()


if __name__ == "__main__":
    try:
        main()
    except LoopcloseError as error:
        sys.exit(str(error))
