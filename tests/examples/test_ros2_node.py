# SPDX-License-Identifier: Apache-2.0
"""The node without ROS: messages are stand-ins with the fields that ROS 2 gives them."""

import sys
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam import Camera, Config, SlamError, open_sequence

SMALL_CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5, depth_scale=1000.0)
LATER_S = 0.013  # the odometry's poses than the images
T_BASE_CAM = np.array(
    [[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.05], [0.0, -1.0, 0.0, 0.3], [0.0, 0.0, 0.0, 1.0]]
)


class Message(SimpleNamespace):
    """A message whose fields come to be when they are asked for."""

    def __getattr__(self, name):
        if name.startswith("__"):
            raise AttributeError(name)
        setattr(self, name, [] if name in ("points", "markers") else Message())
        return getattr(self, name)


def header(time_s, frame_id="camera_optical"):
    nanoseconds = round(time_s * 1e9)
    stamp = SimpleNamespace(sec=nanoseconds // 10**9, nanosec=nanoseconds % 10**9)
    return SimpleNamespace(stamp=stamp, frame_id=frame_id)


def image(time_s, pixels, encoding, padding=0, is_bigendian=False):
    rows = np.ascontiguousarray(pixels).view(np.uint8).reshape(len(pixels), -1)
    rows = np.pad(rows, ((0, 0), (0, padding)))
    return SimpleNamespace(
        header=header(time_s),
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=is_bigendian,
        step=rows.shape[1],
        data=rows.tobytes(),
    )


def transform(T):
    x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
    position = SimpleNamespace(x=T[0, 3], y=T[1, 3], z=T[2, 3])
    return position, SimpleNamespace(x=x, y=y, z=z, w=w)


def odometry(time_s, T):
    position, orientation = transform(T)
    pose = SimpleNamespace(pose=SimpleNamespace(position=position, orientation=orientation))
    return SimpleNamespace(header=header(time_s, "odom"), child_frame_id="base_link", pose=pose)


def camera_info(**changes):
    K = [262.5, 0.0, 159.5, 0.0, 262.5, 119.5, 0.0, 0.0, 1.0]
    values = {"width": 320, "height": 240, "k": K, "d": [], "distortion_model": "plumb_bob"}
    return SimpleNamespace(**{**values, **changes})


COLOUR = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)


@pytest.mark.parametrize("encoding", ["rgb8", "bgr8", "rgba8", "bgra8"])
def test_colour_is_rgb_whatever_its_order_and_padding(example, encoding):
    sent = COLOUR[..., ::-1] if encoding.startswith("b") else COLOUR
    if encoding.endswith("a8"):
        sent = np.dstack([sent, np.full(sent.shape[:2], 255, np.uint8)])
    np.testing.assert_array_equal(example.colour(image(0.0, sent, encoding, padding=5)), COLOUR)


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(("encoding", "kind", "unit"), [("16UC1", "u2", 1000), ("32FC1", "f4", 1)])
def test_depth_is_metres_whatever_is_sent(example, encoding, kind, unit, order):
    sent = np.array([[1.0, 2.5, 0.0], [0.5, 4.0, 3.0]])
    message = image(0.0, (sent * unit).astype(order + kind), encoding, 6, order == ">")
    depth_m = example.depth_m(message)
    assert depth_m.dtype == np.float32
    np.testing.assert_allclose(depth_m, sent, atol=1e-6)


def test_depth_that_is_none_is_unknown(example):
    sent = np.array([[np.nan, np.inf, -1.0, 2.0]], np.float32)
    np.testing.assert_array_equal(example.depth_m(image(0.0, sent, "32FC1")), [[0, 0, 0, 2]])


def test_other_encodings_are_refused(example):
    with pytest.raises(SlamError, match="not 'yuv422'"):
        example.colour(image(0.0, COLOUR, "yuv422"))
    with pytest.raises(SlamError, match="not 'rgb8'"):
        example.depth_m(image(0.0, COLOUR, "rgb8"))


def test_a_camera_is_that_of_its_calibration(example):
    assert example.camera(camera_info()) == SMALL_CAMERA
    bent = example.camera(camera_info(d=[0.1, -0.2, 0.0, 0.01]))
    assert bent.distortion == (0.1, -0.2, 0.0, 0.01, 0.0)


@pytest.mark.parametrize(
    "wrong",
    [{"k": [0.0] * 9}, {"d": [0.1] * 8}, {"d": [0.1] * 4, "distortion_model": "equidistant"}],
    ids=["not calibrated", "eight coefficients", "fisheye"],
)
def test_a_camera_that_cannot_be_used_is_refused(example, wrong):
    with pytest.raises(SlamError):
        example.camera(camera_info(**wrong))


def test_a_transform_survives_there_and_back(example):
    T = T_BASE_CAM
    np.testing.assert_allclose(example.matrix(*transform(T)), T, atol=1e-12)
    message = Message()
    example.fill_transform(message, T)
    np.testing.assert_allclose(example.matrix(message.translation, message.rotation), T, atol=1e-12)


def moved(x):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.1 * x]).as_matrix()
    T[0, 3] = x
    return T


def stamp_of(message):
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


@pytest.mark.parametrize("seed", range(3))
def test_what_belongs_together_is_found_in_whatever_order_it_comes(example, seed):
    """Depth is 6 ms late, poses come at another rate, and messages up to 0.1 s out of turn."""
    rng = np.random.default_rng(seed)
    images_s, poses_s = 10.0 + np.arange(30) / 30.0, 9.99 + np.arange(60) / 50.0
    events = [(t, "add_colour", image(t, COLOUR, "rgb8")) for t in images_s]
    events += [(t, "add_depth", image(t + 0.006, COLOUR, "16UC1")) for t in images_s]
    events += [(t, "add_pose", odometry(t, moved(t))) for t in poses_s]
    delay_s = dict(zip(("add_colour", "add_depth", "add_pose"), 0.1 * rng.random(3), strict=True))
    pairing, seen = example.Pairing(), []
    for _, kind, message in sorted(events, key=lambda each: each[0] + delay_s[each[1]]):
        getattr(pairing, kind)(message)
        while ready := pairing.next():
            seen.append(ready)
    assert [each[0] for each in seen] == pytest.approx(images_s)
    for time_s, colour, depth, T in seen:
        assert stamp_of(colour) == pytest.approx(time_s)
        assert stamp_of(depth) == pytest.approx(time_s + 0.006)
        np.testing.assert_allclose(T, moved(time_s), atol=1e-9)


def test_images_without_depth_or_before_the_first_pose_are_left_out(example):
    pairing = example.Pairing()
    for time_s in (1.0, 1.1, 1.2, 1.3):
        pairing.add_colour(image(time_s, COLOUR, "rgb8"))
        if time_s != 1.2:
            pairing.add_depth(image(time_s, COLOUR, "16UC1"))
    for time_s in (1.05, 1.15, 1.15, 1.25, 1.35):  # one of them comes twice
        pairing.add_pose(odometry(time_s, moved(time_s)))
    seen = iter(pairing.next, None)
    assert [each[0] for each in seen] == pytest.approx([1.1, 1.3])


def test_an_image_does_not_wait_for_ever_for_a_pose(example):
    pairing = example.Pairing()
    pairing.add_pose(odometry(1.0, moved(1.0)))
    seen = []
    for time_s in 1.0 + np.arange(10) / 10.0:
        pairing.add_colour(image(time_s, COLOUR, "rgb8"))
        pairing.add_depth(image(time_s, COLOUR, "16UC1"))
        seen += iter(pairing.next, None)
    assert [each[0] for each in seen] == pytest.approx([1.0, 1.1, 1.2, 1.3])
    assert [each[3] is None for each in seen] == [False, True, True, True]


def test_markers_are_points_and_lines_in_the_map(example):
    ends = np.arange(12.0).reshape(2, 2, 3)
    drawing = example.Drawing(ends[:, 0], ends, ends[:1])
    keyframes, links, loops = example.markers(drawing, Message, Message)
    assert [each.type for each in (keyframes, links, loops)] == [8, 5, 5]
    assert len({each.id for each in (keyframes, links, loops)}) == 3
    assert {each.header.frame_id for each in (keyframes, links, loops)} == {"map"}
    points = [(p.x, p.y, p.z) for p in links.points]
    assert points == [tuple(each) for each in ends.reshape(4, 3).tolist()]
    assert (len(keyframes.points), len(loops.points)) == (2, 2)
    assert all(each.color.a == 1.0 and each.scale.x > 0.0 for each in (keyframes, links, loops))


@pytest.fixture(scope="module")
def there_and_back(recording):
    """Return times, frames and true poses of a camera that goes a third of the room and back."""
    sequence = open_sequence(recording, Config().input)
    return sequence.timestamps_s, list(sequence), sequence.ground_truth.T_world_cam


@pytest.fixture(scope="module")
def messages(there_and_back):
    """Return what a robot's topics would send, in turn; its odometry turns 4 % too far."""
    times_s, frames, cameras = there_and_back
    base = cameras @ np.linalg.inv(T_BASE_CAM)
    T = [base[0]]
    for step in np.linalg.inv(base[:-1]) @ base[1:]:
        error = np.eye(4)
        error[:3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.01]).as_matrix()
        T.append(T[-1] @ step @ error)
    sent = [("camera_info", camera_info())]
    for time_s, frame, T_odom_base in zip(times_s, frames, T, strict=True):
        depth = np.rint(1000.0 * frame.depth_m).astype(np.uint16)
        sent += [
            ("odometry", odometry(time_s, T_odom_base)),
            ("color", image(time_s, frame.rgb, "rgb8")),
            ("depth", image(time_s, depth, "16UC1")),
        ]
    return sent, np.array(T)


@pytest.fixture
def ros(messages, monkeypatch):
    """Put modules that are none in the place of ROS 2's; spinning sends the messages, then ends."""
    published, subscribed, told = SimpleNamespace(tf=[], graph=[]), {}, []
    tf_knows = iter([False, False])  # the first two times it is asked

    transform_exception = type("TransformException", (Exception,), {})

    class Buffer:
        def lookup_transform(self, base, of_camera, _):
            assert (base, of_camera) == ("base_link", "camera_optical")
            if not next(tf_knows, True):
                raise transform_exception("no such frame")
            translation, rotation = transform(T_BASE_CAM)
            found = SimpleNamespace(translation=translation, rotation=rotation)
            return SimpleNamespace(transform=found)

    node = SimpleNamespace(
        create_publisher=lambda kind, topic, qos: SimpleNamespace(publish=published.graph.append),
        create_subscription=lambda kind, topic, callback, qos: subscribed.update({topic: callback}),
        get_logger=lambda: SimpleNamespace(warning=lambda text, **_: told.append(text)),
    )

    def spin(_):
        for topic, message in messages[0]:
            subscribed[topic](message)
        raise KeyboardInterrupt

    contents = {
        "rclpy": {
            "init": lambda **_: None,
            "create_node": lambda _: node,
            "spin": spin,
            "shutdown": lambda: None,
        },
        "rclpy.qos": {"qos_profile_sensor_data": object()},
        "rclpy.signals": {"SignalHandlerOptions": SimpleNamespace(NO=0)},
        "rclpy.time": {"Time": object},
        "tf2_ros": {
            "Buffer": Buffer,
            "TransformException": transform_exception,
            "TransformListener": lambda buffer, node: None,
            "TransformBroadcaster": lambda node: SimpleNamespace(sendTransform=published.tf.append),
        },
        "geometry_msgs.msg": {"TransformStamped": Message, "Point": Message},
        "nav_msgs.msg": {"Odometry": Message},
        "sensor_msgs.msg": {"Image": Message, "CameraInfo": Message},
        "visualization_msgs.msg": {"Marker": Message, "MarkerArray": Message},
    }
    for name, content in contents.items():
        package, _, part = name.partition(".")
        for each in (package, name):
            if each not in sys.modules:
                monkeypatch.setitem(sys.modules, each, ModuleType(each))
        vars(sys.modules[name]).update(content)
        if part:
            setattr(sys.modules[package], part, sys.modules[name])
    return SimpleNamespace(published=published, told=told)


def test_the_node_sends_the_map_and_draws_it(example, ros, messages, there_and_back, capsys):
    times_s, _, cameras = there_and_back
    example.main([])
    assert ros.told == ["waiting for tf: no such frame"] * 2
    sent = ros.published.tf
    assert len(sent) > 50
    assert {(each.header.frame_id, each.child_frame_id) for each in sent} == {("map", "odom")}
    stamps_s = np.array([stamp_of(each) for each in sent])
    index = np.searchsorted(times_s, stamps_s - 1e-6)
    T_map_odom = np.array(
        [example.matrix(each.transform.translation, each.transform.rotation) for each in sent]
    )
    T_odom_base, T_true = messages[1][index], (cameras @ np.linalg.inv(T_BASE_CAM))[index]
    # The map begins where the robot was by its odometry when the first image was taken.
    T_true = T_odom_base[0] @ np.linalg.inv(T_true[0]) @ T_true
    corrected = T_map_odom @ T_odom_base
    off_m, was_off_m = (
        np.linalg.norm(each[:, :3, 3] - T_true[:, :3, 3], axis=1)
        for each in (corrected, T_odom_base)
    )
    assert np.sqrt((off_m**2).mean()) < 0.5 * np.sqrt((was_off_m**2).mean())
    keyframes, links, loops = ros.published.graph[-1].markers
    assert len(keyframes.points) > 5 and len(links.points) >= 2 * (len(keyframes.points) - 1)
    assert len(loops.points) % 2 == 0
    seen = np.array([(p.x, p.y, p.z) for p in keyframes.points])
    at = (T_true @ T_BASE_CAM)[:, :3, 3]
    assert np.linalg.norm(seen[:, None] - at[None], axis=2).min(axis=1).max() < 0.05
    assert "keyframes, " in capsys.readouterr().out


def test_without_ros_it_says_what_is_missing(example, monkeypatch):
    monkeypatch.setitem(sys.modules, "geometry_msgs", None)
    with pytest.raises(SlamError, match=r"no ROS 2 here, geometry_msgs.* is missing: source"):
        example.main([])
