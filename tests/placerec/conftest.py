# SPDX-License-Identifier: Apache-2.0
import math
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from placerec.datasets import PlaceDataset
from placerec.errors import RecognizerError
from placerec.evaluation import embeddings
from placerec.evaluation.bootstrap import Intervals
from placerec.evaluation.measurement import Cost, Measured
from placerec.evaluation.precision_recall import BestMatches, Curve, Evaluation

if TYPE_CHECKING:
    import torch

DATA = Path(os.environ.get("LOOPCLOSE_DATA", Path(__file__).parents[3] / "shared" / "data"))


def pytest_collection_finish():
    # What a test computes is so small that a second thread only waits, for long on a busy machine.
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


@pytest.fixture
def real_data() -> Callable[[str], Path]:
    def find(name: str) -> Path:
        folder = DATA / name
        if not folder.is_dir():
            pytest.skip(f"{name} is not under {DATA} (LOOPCLOSE_DATA names another place)")
        return folder

    return find


@pytest.fixture(scope="session")
def write_image() -> Callable[..., Path]:
    def write(path: Path, seed: int = 0, channels: int = 3) -> Path:
        path.parent.mkdir(parents=True, exist_ok=True)
        shape = (12, 16) if channels == 1 else (12, 16, channels)
        image = np.random.default_rng(seed).integers(0, 256, shape, np.uint8)
        assert cv2.imwrite(str(path), image)
        return path

    return write


@pytest.fixture(scope="session")
def error_of() -> Callable[..., str]:
    """Return what calls a function that must refuse, and returns its error of one line."""

    def call(function: Callable[..., object], *arguments: object) -> str:
        with pytest.raises(RecognizerError) as caught:
            function(*arguments)
        assert "\n" not in str(caught.value)
        return str(caught.value)

    return call


def _varint(number: int) -> bytes:
    low, rest = number & 0x7F, number >> 7
    return bytes([low | 0x80]) + _varint(rest) if rest else bytes([low])


def _chunk(field: int, content: bytes) -> bytes:
    return _varint(field << 3 | 2) + _varint(len(content)) + content


@pytest.fixture(scope="session")
def write_caffemodel() -> Callable[..., Path]:
    """Return what writes the convolutions of layers as Caffe does, now or (old) before 2015."""

    def blob(values: np.ndarray, old: bool) -> bytes:
        if old:
            shape = (1,) * (4 - values.ndim) + values.shape
            dims = b"".join(_varint(f << 3) + _varint(n) for f, n in enumerate(shape, 1))
            return dims + b"".join(_varint(5 << 3 | 5) + value.tobytes() for value in values.flat)
        dims = _chunk(7, _chunk(1, b"".join(map(_varint, values.shape))))
        return _chunk(5, values.astype("<f4").tobytes()) + dims

    def write(path: Path, layers: "torch.nn.Sequential", old: bool = False) -> Path:
        of_net, of_name, of_blobs = (2, 4, 6) if old else (100, 1, 7)
        content = _chunk(1, b"a net") + _varint(3 << 3 | 1) + bytes(8)  # a field to be skipped
        for name, layer in layers.named_children():
            parameters = [value.detach().numpy() for value in layer.parameters()]
            blobs = b"".join(_chunk(of_blobs, blob(values, old)) for values in parameters)
            content += _chunk(of_net, _chunk(of_name, name.encode()) + _varint(80) + b"\1" + blobs)
        path.write_bytes(content)
        return path

    return write


@pytest.fixture
def later_run(monkeypatch) -> Callable[[], None]:
    """Return what makes all embeddings kept so far those of an earlier run."""
    return lambda: monkeypatch.setattr(embeddings, "_STARTED_S", math.inf)


@pytest.fixture(scope="session")
def measured(tmp_path_factory, write_image) -> Measured:
    """Return a measurement on two drives of two images each, with figures that are easy to tell."""
    folder = tmp_path_factory.mktemp("walk")
    paths = tuple(write_image(folder / f"{i}.png", seed=i) for i in range(4))
    truth = np.eye(2, dtype=np.bool_)
    dataset = PlaceDataset("walk", paths, np.arange(2), np.arange(2, 4), truth, np.ones_like(truth))
    curve = Curve(np.array([0.9, 0.1]), np.array([1.0, 0.5]), np.array([0.5, 1.0]))
    evaluation = Evaluation(
        similarities=np.array([[0.9, 0.2], [0.6, 0.1]], np.float32),
        pair_curve=curve,
        best_matches=BestMatches(
            queries=np.arange(2),
            references=np.zeros(2, np.int64),
            similarities=np.array([0.9, 0.6], np.float32),
            are_right=np.array([True, False]),
        ),
        best_match_curve=Curve(np.array([0.9, 0.6]), np.array([1.0, 0.25]), np.array([0.5, 1.0])),
        recall_at_1=0.25,
        recall_at_5=0.5,
        recall_at_10=0.75,
    )
    return Measured(
        dataset=dataset,
        recognizer="short",
        weights="",
        trained_on=(),
        evaluation=evaluation,
        intervals=Intervals((0.5, 0.9), (0.125, 0.6)),
        cost=Cost(embed_ms=12.34, compare_ms=0.000123, dimension=512, embedding_bytes=2048),
        timed_on=None,
    )


@pytest.fixture(scope="session")
def write_onnx() -> Callable[..., Path]:
    """Return what writes a network of the mean colours of 8 x 8 pixels, (N, D).

    It takes the shape of the input, the network's last node, if not one that flattens, the names
    and shapes of its outputs, its metadata, and the file in which a tensor of it is to lie.
    """
    import onnx  # takes a while

    make, floats = onnx.helper, onnx.TensorProto.FLOAT

    def write(
        path: Path,
        shape: tuple[object, ...] = ("n", 3, 24, 32),
        last: tuple[str, dict[str, object]] = ("Flatten", {}),
        outputs: dict[str, tuple[object, ...]] | None = None,
        metadata: dict[str, str] | None = None,
        tensor_file: str | None = None,
        domain: str = "",
    ) -> Path:
        outputs = outputs or {"embedding": ("n", "d")}
        one = onnx.numpy_helper.from_array(np.ones((1, 1, 1, 1), np.float32), "one")
        if tensor_file is not None:
            onnx.external_data_helper.set_external_data(one, tensor_file, 0, 4)
            one.ClearField("raw_data")
        is_last = shape[1] != 3 and shape[-1] == 3
        nodes = [
            make.make_node("Transpose", ["image"], ["first"], perm=[0, 3, 1, 2])
            if is_last
            else make.make_node("Identity", ["image"], ["first"]),
            make.make_node("Mul", ["first", "one"], ["same"]),
            make.make_node("AveragePool", ["same"], ["means"], kernel_shape=[8, 8], strides=[8, 8]),
            make.make_node(last[0], ["means"], [next(iter(outputs))], domain=domain, **last[1]),
            *(
                make.make_node("Flatten" if len(of) == 2 else "Identity", ["means"], [name])
                for name, of in list(outputs.items())[1:]
            ),
        ]
        told = [make.make_tensor_value_info(name, floats, of) for name, of in outputs.items()]
        image = make.make_tensor_value_info("image", floats, shape)
        graph = make.make_graph(nodes, "colours", [image], told, [one])
        opsets = [make.make_opsetid("", 17), *([make.make_opsetid(domain, 1)] if domain else [])]
        model = make.make_model(graph, opset_imports=opsets, ir_version=8)
        make.set_model_props(model, metadata or {})
        path.write_bytes(model.SerializeToString())
        return path

    return write
