# SPDX-License-Identifier: Apache-2.0
import hashlib
import os
import threading
import tracemalloc
import zipfile
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from torch.nn import functional

from placerec.errors import RecognizerError
from placerec.networks import TRUNKS, PlaceNetwork
from placerec.networks.pretrained import download_pretrained, load_pretrained
from placerec.networks.weights_file import save_weights

SMALL = (64, 64)
ROOT = Path(__file__).parents[3]
WEIGHTS = Path(os.environ.get("LOOPCLOSE_WEIGHTS", ROOT / "../shared/weights"))
DATA = Path(os.environ.get("LOOPCLOSE_DATA", ROOT / "../shared/data"))
IMAGENET_DESK = 526


def _official(name, seed=1):
    """Return weights with the names of torchvision's file, the original layers included."""
    whole = PlaceNetwork(TRUNKS[name], 2, size_px=SMALL, seed=seed)
    state = {n: v for n, v in whole.state_dict().items() if n.startswith("features.")}
    return state | {
        "classifier.1.weight": torch.zeros(4096, 9),
        "classifier.1.bias": torch.zeros(4096),
    }


@pytest.mark.parametrize("name", ["alexnet", "vgg16"])
@pytest.mark.parametrize("legacy", [False, True])
def test_official_file_loads_by_path(tmp_path, name, legacy):
    path = tmp_path / "official.pth"
    torch.save(_official(name), path, _use_new_zipfile_serialization=not legacy)
    network = PlaceNetwork(TRUNKS[name], 3, size_px=SMALL)
    load_pretrained(network, path)
    for parameter, value in _official(name).items():
        if parameter.startswith("features."):
            assert torch.equal(network.state_dict()[parameter], value)


def test_cut_trunk_takes_its_part(tmp_path):
    torch.save(_official("alexnet"), tmp_path / "official.pth")
    network = PlaceNetwork(TRUNKS["alexnet"], 3, size_px=SMALL, block="conv2")
    load_pretrained(network, tmp_path / "official.pth")
    assert torch.equal(network.features[3].weight, _official("alexnet")["features.3.weight"])


@pytest.mark.parametrize(
    ("name", "count", "third"),
    [("squeezenet", 50, "fire2/conv1x1_2.weight"), ("mobilenet_v2", 102, "conv02.weight")],
)
def test_archive_of_arrays_in_half_precision(tmp_path, name, count, third):
    source = PlaceNetwork(TRUNKS[name], 2, size_px=SMALL, seed=3)
    arrays = {
        TRUNKS[name].name_in_file(parameter): value.numpy().astype(np.float16)
        for parameter, value in source.features.state_dict().items()
    }
    assert len(arrays) == count
    assert third in arrays
    np.savez(tmp_path / "weights.npz", extra=np.zeros(3), **arrays)
    network = PlaceNetwork(TRUNKS[name], 2, size_px=SMALL)
    load_pretrained(network, tmp_path / "weights.npz")
    for parameter, value in network.features.state_dict().items():
        torch.testing.assert_close(value, source.features.state_dict()[parameter].half().float())
        assert value.dtype == torch.float32


class _Evil:
    def __reduce__(self):
        return (pytest.fail, ("a pickle ran",))


def _refuse(path, name, message):
    network = PlaceNetwork(TRUNKS[name], 2, size_px=SMALL)
    before = {n: v.clone() for n, v in network.state_dict().items()}
    with pytest.raises(RecognizerError, match=message) as error:
        load_pretrained(network, path)
    assert "\n" not in str(error.value)
    assert all(torch.equal(v, before[n]) for n, v in network.state_dict().items())


def test_what_an_earlier_training_wrote_is_gone_on_from(tmp_path):
    earlier = PlaceNetwork(TRUNKS["mobilenet_v2"], 2, size_px=SMALL, block="block3", seed=1)
    path = tmp_path / "weights.safetensors"
    save_weights(earlier, path, 0.5)
    network = PlaceNetwork(TRUNKS["mobilenet_v2"], 7, size_px=SMALL, block="block2")
    load_pretrained(network, path)
    for parameter, value in network.features.state_dict().items():
        assert torch.equal(value, earlier.features.state_dict()[parameter].half().float())
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(RecognizerError, match=r"^the weights file is damaged"):
        load_pretrained(network, path)


def test_pickle_that_would_run_code_is_refused(tmp_path):
    torch.save({"features.0.weight": _Evil()}, tmp_path / "evil.pth")
    _refuse(tmp_path / "evil.pth", "alexnet", "would run code")
    np.savez(tmp_path / "evil.npz", conv1=np.array([_Evil()], dtype=object))
    _refuse(tmp_path / "evil.npz", "squeezenet", "would run code")


@pytest.mark.parametrize("suffix", [".npz", ".pth"])
def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path, suffix):
    path = tmp_path / f"bomb{suffix}"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(100 << 20))
    tracemalloc.start()
    _refuse(path, "alexnet", "damaged")
    peak_bytes = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak_bytes < 10 << 20


def test_a_checkpoint_of_wrong_types_is_refused(tmp_path):
    path = tmp_path / "odd.pth"
    for odd in ({"state_dict": {1: torch.ones(1), "a": 2}}, {3: torch.ones(1)}, {"a": [1]}, 5):
        torch.save(odd, path)
        _refuse(path, "alexnet", "named tensors")


def test_truncated_missing_and_foreign_files_are_refused(tmp_path):
    path = tmp_path / "official.pth"
    torch.save(_official("alexnet"), path)
    _refuse(path, "vgg16", r"features.0.weight is \(64, 3, 11, 11\), not \(64, 3, 3, 3\)|no ")
    _refuse(path, "squeezenet", "there is no conv1.weight")
    _refuse(tmp_path / "none.pth", "alexnet", "No such file")
    path.write_bytes(path.read_bytes()[:5000])
    _refuse(path, "alexnet", "damaged")
    torch.save([1, 2], path)
    _refuse(path, "alexnet", "named tensors")
    (tmp_path / "cut.npz").write_bytes(b"PK\x03\x04 cut")
    _refuse(tmp_path / "cut.npz", "squeezenet", "damaged")


@pytest.fixture
def server(tmp_path):
    folder = tmp_path / "server"
    folder.mkdir()
    handler = partial(_Quiet, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as http:
        threading.Thread(target=http.serve_forever, args=(0.02,), daemon=True).start()
        yield folder, f"http://127.0.0.1:{http.server_port}"
        http.shutdown()


class _Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *arguments):
        pass


def test_download_is_checked_and_made_once(server, tmp_path):
    folder, url = server
    torch.save(_official("alexnet"), folder / "raw")
    content = (folder / "raw").read_bytes()
    name = f"alexnet-owt-{hashlib.sha256(content).hexdigest()[:8]}.pth"
    (folder / name).write_bytes(content)
    path = download_pretrained(TRUNKS["alexnet"], tmp_path / "new" / "cache", f"{url}/{name}")
    assert path == tmp_path / "new" / "cache" / name
    load_pretrained(PlaceNetwork(TRUNKS["alexnet"], 2, size_px=SMALL), path)
    (folder / name).unlink()
    assert download_pretrained(TRUNKS["alexnet"], path.parent, f"{url}/{name}") == path


def test_damaged_download_leaves_nothing(server, tmp_path):
    folder, url = server
    (folder / "alexnet-owt-7be5be79.pth").write_bytes(b"not what was published")
    cache = tmp_path / "cache"
    with pytest.raises(RecognizerError, match=r"SHA-256 begins .{8}, not 7be5be79"):
        download_pretrained(TRUNKS["alexnet"], cache, f"{url}/alexnet-owt-7be5be79.pth")
    assert not cache.exists()


def test_download_that_fails(server, tmp_path):
    _, url = server
    with pytest.raises(RecognizerError, match="cannot be downloaded: HTTP Error 404"):
        download_pretrained(TRUNKS["vgg16"], tmp_path, f"{url}/vgg16-397923af.pth")
    with pytest.raises(RecognizerError, match="no checked download of weights for 'squeezenet'"):
        download_pretrained(TRUNKS["squeezenet"], tmp_path)


def test_published_names_carry_their_checksum():
    assert TRUNKS["alexnet"].url.endswith("/alexnet-owt-7be5be79.pth")
    assert TRUNKS["vgg16"].url.endswith("/vgg16-397923af.pth")


@pytest.mark.parametrize(
    ("name", "file", "head", "classes"),
    [
        ("squeezenet", "squeezenet_v1.0/squeezenet_v1.0.npz", ["conv_final"], slice(0, None)),
        ("mobilenet_v2", "mobilenet_v2/mobilenet_v2.npz", ["conv51", "conv52"], slice(1, None)),
    ],
)
def test_published_weights_see_a_desk(name, file, head, classes):
    path = WEIGHTS / file
    if not path.is_file():
        pytest.skip(f"no {file} in {WEIGHTS}")
    images = sorted((DATA / "rgbd_dataset_freiburg1_desk" / "rgb").glob("*"))[100::150]
    if not images:
        pytest.skip(f"no TUM fr1_desk in {DATA}")
    network = PlaceNetwork(TRUNKS[name], 1).eval()
    load_pretrained(network, path)
    arrays = {n: torch.from_numpy(a.astype(np.float32)) for n, a in np.load(path).items()}
    with torch.inference_mode():
        maps = network.features(
            network.prepare([cv2.cvtColor(cv2.imread(str(i)), cv2.COLOR_BGR2RGB) for i in images])
        )
        for layer in head:
            maps = functional.conv2d(maps, arrays[f"{layer}.weight"], arrays[f"{layer}.bias"])
            maps = maps if layer == head[-1] and len(head) > 1 else functional.relu6(maps)
    best = maps.mean(dim=(2, 3))[:, classes].topk(5).indices
    assert (best == IMAGENET_DESK).any(dim=1).float().mean() >= 0.75
