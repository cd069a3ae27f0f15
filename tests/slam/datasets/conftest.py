# SPDX-License-Identifier: Apache-2.0
"""Recordings to be read: tiny ones, and the same few rendered frames in every format."""

import json
import re
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from placerec.errors import LoopcloseError
from slam.config import InputConfig
from slam.datasets import Sequence, open_sequence, write_camera
from slam.demo import drive, render
from slam.demo.room import Room
from slam.geometry.se3 import to_quaternion
from slam.types import Camera, FloatArray

CAMERA = Camera(32, 24, 30.0, 30.0, 15.5, 11.5, depth_scale=5000.0)
ROOM_CAMERA = Camera(320, 240, 262.5, 262.5, 159.5, 119.5, depth_scale=1000.0)
FRAMES_PER_S = 30.0
MakeFolder = Callable[..., Path]


@pytest.fixture
def opened() -> Callable[[Path], Sequence]:
    return lambda folder: open_sequence(folder, InputConfig())


@pytest.fixture
def fails() -> Callable[..., str]:
    """Return what opens and reads a folder, and returns the one line that this is refused with."""

    def refused(folder: Path, said: str, config: InputConfig | None = None) -> str:
        with pytest.raises(LoopcloseError, match=re.escape(said)) as caught:
            list(open_sequence(folder, config or InputConfig()))
        assert "\n" not in str(caught.value)
        return str(caught.value)

    return refused


@pytest.fixture
def make_folder(tmp_path: Path) -> MakeFolder:
    """Write a TUM folder of tiny frames: frame i is of colour (i, 100, 200), 1 + i / 10 m away."""

    def make(count: int = 6, *, color_suffix: str = "png", name: str = "tiny") -> Path:
        folder = tmp_path / name
        for kind in ("rgb", "depth"):
            (folder / kind).mkdir(parents=True)
        color_lines, depth_lines = ["# color images"], ["# depth maps"]
        for i in range(count):
            bgr = np.full((24, 32, 3), (200, 100, i), np.uint8)
            depth = np.full((24, 32), round(5000 * (1 + i / 10)), np.uint16)
            depth[0, 0] = 0
            cv2.imwrite(str(folder / f"rgb/{i}.{color_suffix}"), bgr)
            cv2.imwrite(str(folder / f"depth/{i}.png"), depth)
            color_lines.append(f"{100 + i / 10:.6f} rgb/{i}.{color_suffix}")
            depth_lines.append(f"{100.004 + i / 10:.6f} depth/{i}.png")
        (folder / "rgb.txt").write_text("\n".join(color_lines) + "\n")
        (folder / "depth.txt").write_text("\n".join(depth_lines) + "\n")
        write_camera(folder / "camera.toml", CAMERA)
        return folder

    return make


@dataclass(frozen=True)
class Walk:
    """A recording in memory, at 30 frames a second from 0 s.

    Attributes:
        color_camera, depth_camera: what the images were made with; often the same.
        rgb, depth_m: (H, W, 3) uint8 and (H, W) float32 of each frame.
        T_world_depth: (N, 4, 4) true poses of the depth camera.
    """

    color_camera: Camera
    depth_camera: Camera
    rgb: list[np.ndarray]
    depth_m: list[np.ndarray]
    T_world_depth: FloatArray

    def camera_in(self, depth_scale: float) -> Camera:
        return replace(self.depth_camera, depth_scale=depth_scale)


@pytest.fixture(scope="session")
def room(built_rooms: Callable[[int], Room]) -> Room:
    return built_rooms(0)


@pytest.fixture(scope="session")
def take(room: Room) -> Callable[..., Walk]:
    """Return what renders a walk through the room, a tenth of a second of it per frame."""

    def rendered(
        count: int,
        depth_camera: Camera,
        color_camera: Camera | None = None,
        T_depth_color: FloatArray | None = None,
    ) -> Walk:
        T_world_depth = drive(np.arange(count) / 10.0, seed=0)
        frames = [render(room, depth_camera, T) for T in T_world_depth]
        depth_m, rgb = [frame.depth_m for frame in frames], [frame.rgb for frame in frames]
        if color_camera is not None:
            T_depth_color = np.eye(4) if T_depth_color is None else T_depth_color
            rgb = [render(room, color_camera, T @ T_depth_color).rgb for T in T_world_depth]
        return Walk(color_camera or depth_camera, depth_camera, rgb, depth_m, T_world_depth)

    return rendered


@pytest.fixture(scope="session")
def walk(take: Callable[..., Walk]) -> Walk:
    """Return 12 frames of 320x240 pixels."""
    return take(12, ROOM_CAMERA)


@pytest.fixture(scope="session")
def tiny_walk() -> Walk:
    """Return 6 frames of 32x24 pixels: frame i is grey i, 1 + i / 10 m away, i m along x."""
    T_world_cam = np.tile(np.eye(4), (6, 1, 1))
    T_world_cam[:, 0, 3] = range(6)
    rgb = [np.full((24, 32, 3), i, np.uint8) for i in range(6)]
    depth_m = [np.full((24, 32), 1.0 + i / 10.0, np.float32) for i in range(6)]
    return Walk(CAMERA, CAMERA, rgb, depth_m, T_world_cam)


Writer = Callable[[Path, Walk], Path]


def save(path: Path, image: np.ndarray, units_per_m: float = 1.0) -> None:
    """Write a colour image, or depth, metres, in the given units."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if image.ndim == 3:
        assert cv2.imwrite(str(path), image[..., ::-1])
    else:
        assert cv2.imwrite(str(path), np.rint(image * units_per_m).astype(np.uint16))


def pose_line(stamp: Any, T: FloatArray) -> str:
    return " ".join(map(str, [stamp, *T[:3, 3], *to_quaternion(T[:3, :3])])) + "\n"


def as_text(matrix: FloatArray) -> str:
    return "".join(" ".join(f"{value:.9f}" for value in row) + "\n" for row in matrix)


def write_tum(folder: Path, walk: Walk) -> Path:
    colors, depths, truth = "", "", ""
    for i, (rgb, depth_m, T) in enumerate(
        zip(walk.rgb, walk.depth_m, walk.T_world_depth, strict=True)
    ):
        save(folder / f"rgb/{i}.png", rgb)
        save(folder / f"depth/{i}.png", depth_m, 5000.0)
        colors += f"{i / FRAMES_PER_S} rgb/{i}.png\n"
        depths += f"{i / FRAMES_PER_S} depth/{i}.png\n"
        truth += pose_line(i / FRAMES_PER_S, T)
    (folder / "rgb.txt").write_text(colors)
    (folder / "depth.txt").write_text(depths)
    (folder / "groundtruth.txt").write_text(truth)
    write_camera(folder / "camera.toml", replace(walk.depth_camera, depth_scale=5000.0))
    return folder


def write_associations(folder: Path, walk: Walk) -> Path:
    write_tum(folder, walk)
    lists = [folder / "rgb.txt", folder / "depth.txt"]
    rows = zip(*(file.read_text().splitlines() for file in lists), strict=True)
    (folder / "associations.txt").write_text("".join(f"{a} {b}\n" for a, b in rows))
    for file in lists:
        file.unlink()
    return folder


# What POV-Ray's left-handed world and camera (y upwards) make of ours.
POV = np.diag([1.0, -1.0, 1.0, 1.0])


def write_icl_nuim(folder: Path, walk: Walk) -> Path:
    for i, (rgb, depth_m) in enumerate(zip(walk.rgb, walk.depth_m, strict=True)):
        save(folder / f"rgb/{i}.png", rgb)
        save(folder / f"depth/{i}.png", depth_m, 5000.0)
    lines = [f"{i} depth/{i}.png {i} rgb/{i}.png\n" for i in range(len(walk.rgb))]
    (folder / "associations.txt").write_text("".join(lines))
    poses = POV @ walk.T_world_depth @ POV
    truth = [pose_line(i, T) for i, T in enumerate(poses)][1:]  # nor has the benchmark the first
    (folder / "traj0.gt.freiburg").write_text("".join(truth))
    return folder


def write_icl_nuim_original(folder: Path, walk: Walk) -> Path:
    eye = walk.depth_camera
    v, u = np.indices((eye.height, eye.width))
    ray = np.sqrt(((u - eye.cx) / eye.fx) ** 2 + ((v - eye.cy) / eye.fy) ** 2 + 1.0)
    for i, T in enumerate(POV @ walk.T_world_depth @ POV):
        stem = folder / f"scene_00_{i:04d}"
        save(stem.with_suffix(".png"), walk.rgb[i])
        distances = (walk.depth_m[i] * ray).ravel()
        stem.with_suffix(".depth").write_text(" ".join(f"{value:.5f}" for value in distances))
        columns = {"cam_pos": T[:3, 3], "cam_dir": T[:3, 2], "cam_up": T[:3, 1]}
        lines = [f"{key:<12} = [{x}, {y}, {z}]';\n" for key, (x, y, z) in columns.items()]
        stem.with_suffix(".txt").write_text("".join(lines) + "cam_angle    = 90;\n")
    return folder


def write_seven_scenes(folder: Path, walk: Walk) -> Path:
    for i, T in enumerate(walk.T_world_depth):
        save(folder / f"frame-{i:06d}.color.png", walk.rgb[i])
        depth = np.rint(walk.depth_m[i] * 1000.0).astype(np.uint16)
        depth[depth == 0] = 65535
        assert cv2.imwrite(str(folder / f"frame-{i:06d}.depth.png"), depth)
        (folder / f"frame-{i:06d}.pose.txt").write_text(as_text(T))
    return folder


def write_replica(folder: Path, walk: Walk) -> Path:
    for i, (rgb, depth_m) in enumerate(zip(walk.rgb, walk.depth_m, strict=True)):
        save(folder / f"results/frame{i:06d}.png", rgb)
        save(folder / f"results/depth{i:06d}.png", depth_m, 6553.5)
    lines = [" ".join(f"{value:.18e}" for value in T.ravel()) for T in walk.T_world_depth]
    (folder / "traj.txt").write_text("\n".join(lines) + "\n")
    camera = walk.depth_camera
    values = {"w": camera.width, "h": camera.height, "fx": camera.fx, "fy": camera.fy}
    values |= {"cx": camera.cx, "cy": camera.cy, "scale": 6553.5}
    (folder / "cam_params.json").write_text(json.dumps({"camera": values}))
    return folder


def write_scannet(folder: Path, walk: Walk) -> Path:
    for i, T in enumerate(walk.T_world_depth):
        save(folder / f"color/{i}.png", walk.rgb[i])
        save(folder / f"depth/{i}.png", walk.depth_m[i], 1000.0)
        (folder / "pose").mkdir(exist_ok=True)
        (folder / f"pose/{i}.txt").write_text(as_text(T))
    (folder / "intrinsic").mkdir()
    for name, camera in (("color", walk.color_camera), ("depth", walk.depth_camera)):
        matrix = np.eye(4)
        matrix[:3, :3] = camera.matrix
        (folder / f"intrinsic/intrinsic_{name}.txt").write_text(as_text(matrix))
        (folder / f"intrinsic/extrinsic_{name}.txt").write_text(as_text(np.eye(4)))
    return folder


def write_images(folder: Path, walk: Walk) -> None:
    for i, (rgb, depth_m) in enumerate(zip(walk.rgb, walk.depth_m, strict=True)):
        save(folder / f"color/{i:05d}.png", rgb)
        save(folder / f"depth/{i:05d}.png", depth_m, 1000.0)


def write_open3d(folder: Path, walk: Walk) -> Path:
    write_images(folder, walk)
    camera = walk.depth_camera
    values = {
        "width": camera.width,
        "height": camera.height,
        "intrinsic_matrix": camera.matrix.T.ravel().tolist(),
    }
    (folder / "camera_intrinsic.json").write_text(json.dumps(values))
    log = [f"{i} {i} {i + 1}\n{as_text(T)}" for i, T in enumerate(walk.T_world_depth)]
    (folder / "trajectory.log").write_text("".join(log))
    return folder


def write_open3d_sample(folder: Path, walk: Walk) -> Path:
    write_open3d(folder, walk)
    (folder / "camera_intrinsic.json").unlink()
    return folder


def write_realsense(folder: Path, walk: Walk) -> Path:
    write_images(folder, walk)
    camera = walk.depth_camera
    values = {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "ppx": camera.cx,
        "ppy": camera.cy,
        "model": "distortion.inverse_brown_conrady",
        "coeffs": [0.0] * 5,
        "depth_scale": 0.001,
    }
    (folder / "intrinsics.json").write_text(json.dumps(values))
    lines = [f"{i},{1000.0 * i / FRAMES_PER_S:.6f}\n" for i in range(len(walk.rgb))]
    (folder / "timestamps.csv").write_text("frame,timestamp_ms\n" + "".join(lines))
    return folder


def write_stray_scanner(folder: Path, walk: Walk) -> Path:
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw\n"]
    for i, (rgb, depth_m) in enumerate(zip(walk.rgb, walk.depth_m, strict=True)):
        save(folder / f"rgb/{i:06d}.png", rgb)
        save(folder / f"depth/{i:06d}.png", depth_m, 1000.0)
        (folder / "confidence").mkdir(exist_ok=True)
        confidence = np.full(depth_m.shape, 2, np.uint8)
        assert cv2.imwrite(str(folder / f"confidence/{i:06d}.png"), confidence)
        fields = pose_line(f"{i:06d}", walk.T_world_depth[i]).split()
        rows.append(", ".join([f"{i / FRAMES_PER_S:.9f}", *fields]) + "\n")
    (folder / "odometry.csv").write_text("".join(rows))
    K = walk.color_camera.matrix
    (folder / "camera_matrix.csv").write_text("\n".join(f"{a}, {b}, {c}" for a, b, c in K))
    return folder


def write_exr(
    path: Path, channels: dict[str, np.ndarray], compression: int = 3, flags: int = 2
) -> None:
    """Write an OpenEXR image of scan lines: not compressed (0), or by ZIPS (2) or ZIP (3)."""
    kinds = {np.dtype(np.uint32): 0, np.dtype(np.float16): 1, np.dtype(np.float32): 2}
    (height, width), names = next(iter(channels.values())).shape, sorted(channels)
    listed = b"".join(
        name.encode() + b"\0" + struct.pack("<iIii", kinds[channels[name].dtype], 0, 1, 1)
        for name in names
    )
    window = struct.pack("<4i", 0, 0, width - 1, height - 1)
    header = struct.pack("<ii", 20000630, flags)
    for name, kind, value in (
        ("channels", "chlist", listed + b"\0"),
        ("compression", "compression", bytes([compression])),
        ("dataWindow", "box2i", window),
        ("displayWindow", "box2i", window),
        ("lineOrder", "lineOrder", b"\0"),
        ("pixelAspectRatio", "float", struct.pack("<f", 1.0)),
        ("screenWindowCenter", "v2f", struct.pack("<2f", 0.0, 0.0)),
        ("screenWindowWidth", "float", struct.pack("<f", 1.0)),
    ):
        header += f"{name}\0{kind}\0".encode() + struct.pack("<i", len(value)) + value
    header += b"\0"
    rows = [b"".join(channels[name][y].tobytes() for name in names) for y in range(height)]
    step = 16 if compression == 3 else 1
    chunks = []
    for y in range(0, height, step):
        plain = b"".join(rows[y : y + step])
        data = deflated(plain) if compression else plain
        data = data if len(data) < len(plain) else plain  # as the format wants it
        chunks.append(struct.pack("<ii", y, len(data)) + data)
    starts = np.cumsum([0, *map(len, chunks[:-1])]) + len(header) + 8 * len(chunks)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(header + starts.astype("<u8").tobytes() + b"".join(chunks))


def deflated(plain: bytes) -> bytes:
    values = np.frombuffer(plain, np.uint8).astype(np.int64)
    halves = np.concatenate([values[0::2], values[1::2]])
    differences = np.diff(halves, prepend=0) + 128
    differences[0] = halves[0]
    return zlib.compress(differences.astype(np.uint8).tobytes())


@pytest.fixture
def save_exr() -> Callable[..., None]:
    return write_exr


def write_record3d(folder: Path, walk: Walk) -> Path:
    for i, (rgb, depth_m) in enumerate(zip(walk.rgb, walk.depth_m, strict=True)):
        save(folder / f"rgb/{i}.png", rgb)
        write_exr(folder / f"depth/{i}.exr", {"R": np.where(depth_m > 0.0, depth_m, np.nan)})
    camera, poses = walk.color_camera, [pose_line(0, T).split()[1:] for T in walk.T_world_depth]
    metadata = {
        "w": camera.width,
        "h": camera.height,
        "K": camera.matrix.T.ravel().tolist(),
        "fps": FRAMES_PER_S,
        "poses": [[float(value) for value in [*pose[3:], *pose[:3]]] for pose in poses],
    }
    (folder / "metadata.json").write_text(json.dumps(metadata))
    return folder


WRITERS: dict[str, Writer] = {
    "tum": write_tum,
    "icl_nuim": write_icl_nuim,
    "icl_nuim_original": write_icl_nuim_original,
    "seven_scenes": write_seven_scenes,
    "replica": write_replica,
    "stray_scanner": write_stray_scanner,
    "record3d": write_record3d,
    "scannet": write_scannet,
    "open3d": write_open3d,
    "associations": write_associations,
    "open3d_sample": write_open3d_sample,
    "realsense": write_realsense,
}


@pytest.fixture(scope="session")
def writers() -> dict[str, Writer]:
    return WRITERS


@pytest.fixture
def export(tmp_path: Path) -> Callable[[str, Walk], Path]:
    """Return what writes a walk in the format of that name."""

    def written(name: str, walk: Walk) -> Path:
        folder = tmp_path / name
        folder.mkdir()
        return WRITERS[name](folder, walk)

    return written


@pytest.fixture
def disagreement() -> Callable[..., FloatArray]:
    """Return what tells how far, metres, one frame's depth is off where another sees the same.

    Every point that frame i sees is carried into the world by its true pose, and from there into
    frame k: (N,) differences between its depth there and what frame k saw at that pixel.
    """

    def measured(sequence: Any, i: int, k: int) -> FloatArray:
        camera = sequence.camera
        times_s = sequence.timestamps_s
        stamps_s = sequence.ground_truth.timestamps_s
        T_i, T_k = (
            sequence.ground_truth.T_world_cam[np.abs(stamps_s - times_s[n]).argmin()]
            for n in (i, k)
        )
        depth_i, depth_k = (sequence.frame(n).depth_m.astype(np.float64) for n in (i, k))
        v, u = np.nonzero(depth_i)
        rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(len(u))])
        points = np.linalg.inv(T_k) @ T_i @ np.vstack([rays * depth_i[v, u], np.ones(len(u))])
        x, y, z = points[:3]
        column = np.rint(camera.fx * x / z + camera.cx).astype(int)
        row = np.rint(camera.fy * y / z + camera.cy).astype(int)
        seen = (
            (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
        )
        there = depth_k[row[seen], column[seen]]
        return np.asarray((z[seen] - there)[there > 0.0])

    return measured
