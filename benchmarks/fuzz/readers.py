# SPDX-License-Identifier: Apache-2.0
"""Every reader of files, each with a small good input made by code."""

import io
import json
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np
import scipy.io
import torch
from numpy.typing import NDArray

from benchmarks.fuzz.containers import archive_of, bag_of, caffemodel_of, exr_of
from benchmarks.large_maps.saved_maps import made_up
from placerec.certificate import fingerprint, read_certificate
from placerec.datasets import open_dataset
from placerec.datasets.images import BrokenImage, find_fault, read_image
from placerec.errors import LoopcloseError
from placerec.evaluation.embedding_file import (
    EmbeddingFile,
    read_embedding_file,
    write_embedding_file,
)
from placerec.networks import TRUNKS, PlaceNetwork
from placerec.networks.pretrained import read_weights
from placerec.networks.weights_file import load_weights, save_weights
from placerec.recognizer import load
from placerec.recognizers.fitted_file import shipped
from placerec.recognizers.gradients import GradientRecognizer
from placerec.training.checkpoint import read_checkpoint
from placerec.training.log import read_log
from slam.commands.named_recordings import named_recordings
from slam.config import Config, InputConfig, load_config, to_toml
from slam.datasets import download, open_sequence, read_camera
from slam.datasets.cameras import read_intrinsics
from slam.datasets.images import read_color, read_depth
from slam.datasets.images.exr import read_exr
from slam.datasets.pose_files import read_odometry, read_trajectory
from slam.output.comparison.runs import read_runs
from slam.output.journal import Header, Journal
from slam.output.ledger.reading import read_ledger
from slam.output.map_folder.folder import load_map, save_map
from slam.output.replay.measurements import (
    MEASUREMENTS,
    Measurements,
    read_measurements,
    write_measurements,
)
from slam.pose_graph import read_g2o
from slam.tracking.tracked_frame import TrackedFrame
from slam.types import Camera

Files = dict[str, bytes]
WIDTH, HEIGHT, FRAMES = 16, 12, 6
_EYE = np.eye(4)
_IMAGE = (np.arange(WIDTH * HEIGHT * 3) % 251).astype(np.uint8).reshape(HEIGHT, WIDTH, 3)
_DEPTH = np.full((HEIGHT, WIDTH), 1500, np.uint16)
_CAMERA = (
    "width = 16\nheight = 12\nfx = 15.0\nfy = 15.0\ncx = 8.0\ncy = 6.0\ndepth_scale = 1000.0\n"
)


@dataclass(frozen=True)
class Reader:
    """Reads one file of a folder, of which others are needed to get so far.

    Attributes:
        name: for people, and what it is called on the command line.
        file: the one that is damaged.
        good: makes the content of all files of the folder, by path.
        read: takes the folder and returns anything, or raises LoopcloseError.
        is_text: whether the file is.
    """

    name: str
    file: str
    good: Callable[[], Files]
    read: Callable[[Path], object] = field(repr=False)
    is_text: bool = True

    def lay_out(self, folder: Path) -> bytes:
        """Write the folder, and return the content of the file that is to be damaged."""
        files = self.good()
        for name, content in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        return files[self.file]

    def try_out(self, folder: Path, content: bytes) -> str:
        """Read the folder with another content of the file; return what came of it."""
        (folder / self.file).write_bytes(content)
        try:
            found = self.read(folder)
        except LoopcloseError as error:
            text = str(error)
            assert text.isprintable() and len(text) < 1100, text
            return f"refused: {text}"
        return f"broken: {found.why}" if isinstance(found, BrokenImage) else "read"


def _image(kind: str, image: Any = _IMAGE) -> bytes:
    return bytes(cv2.imencode(kind, image)[1])


def _pose(i: int) -> str:
    return f"{0.1 * i:.3f} 0.25 1.5 0.0 0.0 0.3826834 0.9238795"


def _lines(line: Callable[[int], str], head: str = "") -> bytes:
    return "".join([head, *(f"{line(i)}\n" for i in range(FRAMES))]).encode()


def _matrix(size: int = 4) -> str:
    return "\n".join(" ".join(f"{value:.1f}" for value in row) for row in np.eye(size)) + "\n"


def _images(colour: str, depth: str) -> Files:
    pairs = {colour.format(i): _image(Path(colour).suffix) for i in range(FRAMES)}
    return pairs | {depth.format(i): _image(Path(depth).suffix, _DEPTH) for i in range(FRAMES)}


def _tum() -> Files:
    return _images("rgb/{}.png", "depth/{}.png") | {
        "rgb.txt": _lines(lambda i: f"{100 + i / 30:.6f} rgb/{i}.png", "# colour\n"),
        "depth.txt": _lines(lambda i: f"{100.01 + i / 30:.6f} depth/{i}.png"),
        "groundtruth.txt": _lines(lambda i: f"{100 + i / 30:.6f} {_pose(i)}"),
        "camera.toml": _CAMERA.encode(),
    }


def _associations() -> Files:
    line = "{0:.4f} rgb/{1}.png {0:.4f} depth/{1}.png"
    return _images("rgb/{}.png", "depth/{}.png") | {
        "associations.txt": _lines(lambda i: line.format(100.5 + i / 30, i)),
        "camera.toml": _CAMERA.encode(),
    }


def _icl_nuim() -> Files:
    return _images("rgb/{}.png", "depth/{}.png") | {
        "associations.txt": _lines(lambda i: f"{i} depth/{i}.png {i} rgb/{i}.png"),
        "a.gt.freiburg": _lines(lambda i: f"{i} {_pose(i)}"),
        "camera.toml": _CAMERA.encode(),
    }


def _icl_nuim_original() -> Files:
    files = {"camera.toml": _CAMERA.encode()}
    for i in range(FRAMES):
        files[f"scene_00_{i:04d}.png"] = _image(".png")
        files[f"scene_00_{i:04d}.depth"] = b"1.5 " * (WIDTH * HEIGHT)
        vectors = "cam_pos = [1, 2, 3]';\ncam_dir = [0, 0, 1]';\ncam_up = [0, 1, 0]';\n"
        files[f"scene_00_{i:04d}.txt"] = vectors.encode()
    return files


def _seven_scenes() -> Files:
    files = _images("frame-{:06d}.color.png", "frame-{:06d}.depth.png")
    files |= {f"frame-{i:06d}.pose.txt": _matrix().encode() for i in range(FRAMES)}
    return files | {"camera-intrinsics.txt": b"15 0 8\n0 15 6\n0 0 1\n"}


def _replica() -> Files:
    camera = {"w": WIDTH, "h": HEIGHT, "fx": 15.0, "fy": 15.0, "cx": 8.0, "cy": 6.0, "scale": 1e3}
    row = " ".join(str(value) for value in _EYE.ravel())
    return _images("results/frame{:06d}.jpg", "results/depth{:06d}.png") | {
        "traj.txt": _lines(lambda _: row),
        "cam_params.json": json.dumps({"camera": camera}).encode(),
    }


def _scannet() -> Files:
    files = _images("color/{}.jpg", "depth/{}.png")
    files |= {f"pose/{i}.txt": _matrix().encode() for i in range(FRAMES)}
    intrinsics = b"15 0 8 0\n0 15 6 0\n0 0 1 0\n0 0 0 1\n"
    return files | {f"intrinsic/intrinsic_{kind}.txt": intrinsics for kind in ("color", "depth")}


def _open3d() -> Files:
    matrix = [15.0, 0.0, 0.0, 0.0, 15.0, 0.0, 8.0, 6.0, 1.0]
    camera = {"width": WIDTH, "height": HEIGHT, "intrinsic_matrix": matrix, "depth_scale": 1000.0}
    return _images("color/{:05d}.jpg", "depth/{:05d}.png") | {
        "camera_intrinsic.json": json.dumps(camera).encode(),
        "trajectory.log": _lines(lambda i: f"{i} {i} {i + 1}\n{_matrix()}".rstrip()),
    }


def _realsense() -> Files:
    pinhole = {"fx": 15.0, "fy": 15.0, "ppx": 8.0, "ppy": 6.0}
    lens = {"model": "distortion.brown_conrady", "coeffs": [0.1, 0.0, 0.0, 0.0, 0.0]}
    size = {"width": WIDTH, "height": HEIGHT, "depth_scale": 0.001}
    return _images("color/{:05d}.png", "depth/{:05d}.png") | {
        "intrinsics.json": json.dumps({**size, **pinhole, **lens}).encode(),
        "timestamps.csv": _lines(lambda i: f"{i},{1000 * i / 30:.3f}", "frame,timestamp_ms\n"),
    }


def _stray_scanner() -> Files:
    files = _images("rgb/{:06d}.png", "depth/{:06d}.png")
    certain = _image(".png", np.full((HEIGHT, WIDTH), 2, np.uint8))
    files |= {f"confidence/{i:06d}.png": certain for i in range(FRAMES)}
    array = io.BytesIO()
    np.save(array, _DEPTH)
    files["depth/000000.npy"] = array.getvalue()
    del files["depth/000000.png"]

    def row(i: int) -> str:
        return f"{i / 30:.5f}, {i:06d}, {', '.join(_pose(i).split())}"

    return files | {
        "odometry.csv": _lines(row, "timestamp, frame, x, y, z, qx, qy, qz, qw\n"),
        "camera_matrix.csv": b"15, 0, 8\n0, 15, 6\n0, 0, 1\n",
    }


def _record3d() -> Files:
    values = {"w": WIDTH, "h": HEIGHT, "fps": 30, "K": [15, 0, 0, 0, 15, 0, 8, 6, 1]}
    values["perFrameIntrinsicCoeffs"] = [[15.0, 15.0, 8.0, 6.0]] * FRAMES
    values["frameTimestamps"] = [i / 30 for i in range(FRAMES)]
    files = {f"rgb/{i}.jpg": _image(".jpg") for i in range(FRAMES)}
    files |= {f"depth/{i}.exr": exr_of(_DEPTH.astype(np.float32)) for i in range(FRAMES)}
    return files | {"metadata.json": json.dumps(values).encode()}


def _clips() -> Files:
    rows = _lines(lambda i: f"images/a_frame_{i:06d}.jpg,floor6", "image_path,floor\n")
    floors = rows.replace(b"floor6", b"floor9") + rows.split(b"\n", 1)[1].replace(b"/a_", b"/b_")
    files = {f"images/{clip}_frame_{i:06d}.jpg": _image(".jpg") for clip in "ab" for i in range(6)}
    return files | {"dataset.csv": floors}


def _frame_pairs() -> Files:
    files = {f"{drive}/{i}.png": _image(".png") for drive in ("query", "ref") for i in range(6)}
    return files | {"ground_truth.csv": _lines(lambda i: f"{i},{i};{(i + 1) % 6}", "query,refs\n")}


def _oxford() -> Files:
    matrix = io.BytesIO()
    scipy.io.savemat(matrix, {"truth": np.eye(FRAMES, k=-3)})
    files = {f"Images/{i:04d}.jpg": _image(".jpg") for i in range(FRAMES)}
    return files | {"NewCollegeGroundTruth.mat": matrix.getvalue()}


def _graph() -> Files:
    upper = " ".join("1" if i == k else "0" for i in range(6) for k in range(i, 6))
    lines = [f"VERTEX_SE3:QUAT {i} {_pose(i)}" for i in range(3)]
    lines += [f"EDGE_SE3:QUAT {i} {i + 1} {_pose(1)} {upper}" for i in range(3)]
    return {"graph.g2o": "\n".join(lines).encode()}


def _measurements() -> Files:
    camera = Camera(WIDTH, HEIGHT, 15.0, 15.0, 8.0, 6.0)
    journal = Journal(Header("room", "run_slam room", camera, 0.5, None, ()))
    journal.frames.extend((float(k), TrackedFrame(0, _EYE, _EYE)) for k in range(FRAMES))
    with TemporaryDirectory() as folder:
        path = Path(folder) / MEASUREMENTS
        write_measurements(path, Measurements(journal, None, None))
        return {MEASUREMENTS: path.read_bytes()}


def _embeddings() -> Files:
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.npz"
        write_embedding_file(EmbeddingFile("a", "b", ("c",), 0, np.ones((1, 4), np.float32)), path)
        return {path.name: path.read_bytes()}


def _map() -> Files:
    with TemporaryDirectory() as folder:
        made = replace(made_up(2, seed=0), fingerprint=fingerprint(GradientRecognizer()))
        save_map(Path(folder), made)
        files = (each for each in Path(folder).rglob("*") if each.is_file())
        return {each.relative_to(folder).as_posix(): each.read_bytes() for each in files}


def _ledger() -> Files:
    motion = {"translation_m": [0.0] * 3, "quaternion_xyzw": [0.0, 0.0, 0.0, 1.0]}
    counts = {"version": 1, "query_id": 9, "match_id": 1, "matches": 50, "inliers": 40}
    numbers = ("query_timestamp_s", "match_timestamp_s", "similarity", "min_similarity")
    record: dict[str, Any] = (
        counts | dict.fromkeys(numbers, 0.5) | {"accepted": True, "weight": 1.0}
    )
    record |= dict.fromkeys(
        ("reason", "explanation", "measured", "needed", "margin", "truth", "influence")
    )
    stage = dict.fromkeys(("measured", "needed", "margin"), 0.5)
    record |= {"decided_by": None, "stages": [{"stage": "support", **stage, "passed": True}]}
    record["T_match_query"] = {**motion, "information": [1.0] * 21}
    return {"loops.jsonl": (json.dumps(record) + "\n").encode() * 2}


@cache
def _network() -> bytes:
    network = PlaceNetwork(TRUNKS["mobilenet_v2"], 2, block="block1", grid=(1, 1), size_px=(32, 32))
    path = Path("/dev/shm" if Path("/dev/shm").is_dir() else "/tmp") / "fuzz-network.safetensors"
    save_weights(network, path, 0.5)
    content = path.read_bytes()
    path.unlink()
    return content


def _saved(values: object) -> bytes:
    buffer = io.BytesIO()
    torch.save(values, buffer)
    return buffer.getvalue()


def _arrays() -> bytes:
    buffer = io.BytesIO()
    arrays: dict[str, Any] = {"conv1.weight": _DEPTH.astype(np.float32)}
    np.savez_compressed(buffer, **arrays)
    return buffer.getvalue()


def _checkpoint() -> bytes:
    tensors = {"network": {"a": torch.ones(2)}, "optimizer": {"state": {}, "param_groups": []}}
    sets = dict.fromkeys(("positives", "negatives"), torch.zeros((2, 3), dtype=torch.int64))
    counts = dict.fromkeys(("used", "round", "step"), 1)
    return _saved({"settings": {}, **tensors, **sets, **counts, "elapsed_s": 1.0})


def _frames(folder: Path) -> int:
    sequence = open_sequence(folder, InputConfig())
    frames = list(sequence)
    return len(frames) + len(sequence.warnings)


def _poses(folder: Path, start_s: float = 100.0) -> object:
    return read_odometry(folder / "poses.txt", np.arange(FRAMES) / 30 + start_s, InputConfig())


def _run_folder() -> Files:
    poses = _pose_text("tum")
    return {
        "summary.json": b'{"command": "run_slam room", "warnings": [], "loops_tried": 3}',
        "settings.toml": b"[loop]\ncandidates = 4\n",
        "odometry.txt": poses,
        "trajectory.txt": poses,
        "groundtruth.txt": poses,
    }


def _bag(folder: Path, name: str) -> int:
    return len(list(open_sequence(folder / name, InputConfig())))


def _unpack(folder: Path) -> None:
    download._unpack(folder / "archive.tgz", folder / "unpacked")


def _one(name: str, content: Callable[[], bytes]) -> Callable[[], Files]:
    return lambda: {name: content()}


def _of_folder(name: str, good: Callable[[], Files], *files: str) -> list[Reader]:
    binary = (".mat", ".npy", ".exr", ".png", ".jpg")
    return [
        Reader(f"{name}/{Path(file).name}", file, good, _frames, Path(file).suffix not in binary)
        for file in files
    ]


def _of_file(
    name: str, file: str, content: Callable[[], bytes], read: Callable[[Path], object], text: bool
) -> Reader:
    return Reader(name, file, _one(file, content), lambda folder: read(folder / file), text)


def _pose_text(kind: str) -> bytes:
    row = " ".join(str(value) for value in _EYE[:3].ravel())
    return {
        "tum": _lines(lambda i: f"{100 + i / 30:.6f} {_pose(i)}"),
        "kitti": _lines(lambda _: row),
        "euroc": _lines(lambda i: f"{10**18 + 33333333 * i},{i},0,0,1,0,0,0", "#timestamp,p,q\n"),
        "planar": _lines(lambda i: f"{100 + i / 30:.6f} 1 2 0.5"),
    }[kind]


def _place_dataset(name: str, good: Callable[[], Files], file: str, text: bool = True) -> Reader:
    return Reader(f"places/{name}", file, good, lambda folder: open_dataset(str(folder)), text)


_FOLDERS = [
    *_of_folder("tum", _tum, "rgb.txt", "depth.txt", "groundtruth.txt", "camera.toml"),
    *_of_folder("associations", _associations, "associations.txt"),
    *_of_folder("icl-nuim", _icl_nuim, "associations.txt", "a.gt.freiburg"),
    *_of_folder(
        "icl-nuim-original", _icl_nuim_original, "scene_00_0001.txt", "scene_00_0001.depth"
    ),
    *_of_folder("7-scenes", _seven_scenes, "frame-000001.pose.txt", "camera-intrinsics.txt"),
    *_of_folder("replica", _replica, "traj.txt", "cam_params.json"),
    *_of_folder("scannet", _scannet, "pose/1.txt", "intrinsic/intrinsic_depth.txt"),
    *_of_folder("open3d", _open3d, "trajectory.log", "camera_intrinsic.json"),
    *_of_folder("realsense", _realsense, "timestamps.csv", "intrinsics.json"),
    *_of_folder(
        "stray-scanner", _stray_scanner, "odometry.csv", "camera_matrix.csv", "depth/000000.npy"
    ),
    *_of_folder("record3d", _record3d, "metadata.json", "depth/1.exr"),
    _place_dataset("tum", _tum, "groundtruth.txt"),
    _place_dataset("clips", _clips, "dataset.csv"),
    _place_dataset("frame-pairs", _frame_pairs, "ground_truth.csv"),
    _place_dataset("oxford", _oxford, "NewCollegeGroundTruth.mat", text=False),
]
_IMAGE_READERS: list[tuple[str, NDArray[Any], Callable[[Path], object]]] = [
    (".png", _IMAGE, read_color),
    (".jpg", _IMAGE, read_image),
    (".bmp", _IMAGE, read_color),
    (".tiff", _DEPTH, partial(read_depth, depth_scale=1000.0)),
    (".pgm", _DEPTH, partial(read_depth, depth_scale=1000.0)),
    (".webp", _IMAGE, find_fault),
]
_IMAGES = [
    _of_file(f"image{kind}", f"image{kind}", partial(_image, kind, image), read, False)
    for kind, image, read in _IMAGE_READERS
]
_BAGS = [
    Reader(f"bag/{kind}", file, partial(bag_of, kind), partial(_bag, name=name), False)
    for kind, file, name in [
        ("ros1", "recording.bag", "recording.bag"),
        ("ros2", "recording/recording.db3", "recording"),
        ("mcap", "recording/recording.mcap", "recording/recording.mcap"),
    ]
]
_WEIGHTS = [
    _of_file("weights/network", "a.safetensors", _network, load_weights, False),
    _of_file(
        "weights/gradients",
        "b.safetensors",
        lambda: shipped("bag-of-words").read_bytes(),
        lambda path: load(str(path)),
        False,
    ),
    _of_file("weights/pth", "a.pth", lambda: _saved({"a": torch.ones(4)}), read_weights, False),
    _of_file("weights/npz", "a.npz", _arrays, read_weights, False),
    _of_file("weights/caffemodel", "a.caffemodel", caffemodel_of, read_weights, False),
    _of_file("checkpoint", "checkpoint.pt", _checkpoint, lambda p: read_checkpoint(p, {}), False),
]
_TEXTS = [
    _of_file("camera", "camera.toml", lambda: _CAMERA.encode(), read_camera, True),
    _of_file(
        "recordings",
        "list.txt",
        lambda: b"# of ours\nmon/cam\ncam_b = tue/cam\nfr1_desk\n",
        lambda path: named_recordings([str(path)]),
        True,
    ),
    _of_file("settings", "settings.toml", lambda: to_toml(Config()).encode(), load_config, True),
    _of_file(
        "intrinsics", "i.json", lambda: _realsense()["intrinsics.json"], read_intrinsics, True
    ),
    Reader("g2o", "graph.g2o", _graph, lambda folder: read_g2o(folder / "graph.g2o")),
    *(
        Reader(f"run/{file}", file, _run_folder, lambda folder: read_runs([folder]))
        for file in ("summary.json", "settings.toml", "trajectory.txt")
    ),
    *(
        _of_file(f"compared/{kind}", "poses.txt", partial(_pose_text, kind), read_trajectory, True)
        for kind in ("tum", "kitti", "euroc")
    ),
    Reader(
        "measurements",
        MEASUREMENTS,
        _measurements,
        lambda folder: read_measurements(folder / MEASUREMENTS, Config()),
        False,
    ),
    Reader(
        "embeddings",
        "a.npz",
        _embeddings,
        lambda folder: read_embedding_file(folder / "a.npz"),
        False,
    ),
    Reader("map", "manifest.json", _map, lambda folder: load_map(folder, GradientRecognizer())),
    Reader("ledger", "loops.jsonl", _ledger, lambda folder: read_ledger(folder / "loops.jsonl")),
    _of_file(
        "training-log",
        "log.csv",
        lambda: (
            b"step,round,loss,active_share,sets_left,"
            b"learning_rate,images_per_s,elapsed_s,time_to_go_s\n1,1,.5,.5,3,.1,9,1,9\n"
        ),
        read_log,
        True,
    ),
    _of_file(
        "certificate",
        "c.json",
        lambda: (shipped("netvlad").parent / "netvlad.certificate.json").read_bytes(),
        read_certificate,
        True,
    ),
    *(
        Reader(f"poses/{kind}", "poses.txt", _one("poses.txt", partial(_pose_text, kind)), _poses)
        for kind in ("tum", "kitti", "planar")
    ),
    Reader(
        "poses/euroc",
        "poses.txt",
        _one("poses.txt", partial(_pose_text, "euroc")),
        partial(_poses, start_s=1e9),
    ),
]
READERS = {
    reader.name: reader
    for reader in [
        *_FOLDERS,
        *_TEXTS,
        *_IMAGES,
        *_WEIGHTS,
        *_BAGS,
        Reader("archive", "archive.tgz", _one("archive.tgz", archive_of), _unpack, False),
        _of_file("exr", "depth.exr", lambda: exr_of(_DEPTH.astype(np.float32)), read_exr, False),
    ]
}
