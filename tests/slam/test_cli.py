# SPDX-License-Identifier: Apache-2.0
import errno
import html
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import cache
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from typing import NamedTuple

import cv2
import numba
import numpy as np
import pytest
from tqdm import tqdm

from placerec import certificate as certificates
from placerec import files
from placerec.commands import console
from placerec.evaluation import drawing
from placerec.networks import TRUNKS, PlaceNetwork
from placerec.networks.weights_file import save_weights
from placerec.recognizers import onnx_file
from placerec.recognizers.learned import LearnedRecognizer, keep_calibration
from slam.__main__ import main, parse
from slam.config import Config, load_config, to_toml
from slam.datasets import read_camera, write_camera
from slam.evaluation.trajectory import read_tum
from slam.loops.back_end import BackEnd
from slam.loops.loop_closure import LoopCloser
from slam.output import ending
from slam.output.claimed_folder import ClaimedFolder
from slam.system import Slam
from slam.tracking.odometry import RgbdOdometry
from slam.types import SlamError

ROOT = Path(__file__).parents[2]
OUTPUTS = [
    *("groundtruth.txt", "keyframes.txt", "loops.jsonl", "map.ply", "measurements.npz"),
    *(
        "odometry.txt",
        "pose_graph.g2o",
        "report.html",
        "settings.toml",
        "summary.json",
        "trajectory.txt",
    ),
]
QUICK = ("--map.write", "False")


class Ran(NamedTuple):
    code: int
    out: str
    err: str
    folder: Path

    @property
    def complaint(self) -> str:
        """Return the one line that the run ends with where it fails."""
        assert self.code == 2, self.err
        assert "Traceback" not in self.err
        lines = [line for line in self.err.splitlines() if line.startswith("run_slam: ")]
        assert len(lines) == 1 and self.err.endswith(lines[0] + "\n")
        return lines[0].removeprefix("run_slam: ")

    @property
    def warnings(self) -> list[str]:
        assert self.code == 0, self.err
        return [
            line.split(maxsplit=1)[1]
            for line in self.out.splitlines()
            if line.startswith("warning")
        ]

    @property
    def frames(self) -> str:
        return next(line for line in self.out.splitlines() if line.startswith("frames"))


def names(folder):
    return sorted(path.name for path in folder.iterdir()) if folder.is_dir() else []


_open_session = cache(onnx_file.open_session)  # for the default network is the same in every run


@pytest.fixture
def run_slam(tmp_path, monkeypatch, capsys):
    """Run the command in this process, in an empty folder, with outputs going to ./out."""
    monkeypatch.setattr(onnx_file, "open_session", _open_session)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.delenv("LOOPCLOSE_DATA", raising=False)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setenv("LOOPCLOSE_TUM_URL", "http://127.0.0.1:9")

    def run(*arguments, out="out", is_rendered=False):
        with pytest.MonkeyPatch.context() as patch:
            if not is_rendered:  # figures are painted all the same, but that is the longest part
                patch.setattr(drawing, "_save", lambda *_, **__: b"<svg></svg>")
            code = main([*map(str, arguments), "--out", str(out)])
        printed = capsys.readouterr()
        return Ran(code, printed.out, printed.err, tmp_path / out)

    return run


def edit(path, change):
    lines = path.read_text().splitlines()
    path.write_text("".join(line + "\n" for line in change(lines)))


def cut_off(path):
    path.write_bytes(path.read_bytes()[:-2000])


def images(folder, kind):
    lines = (folder / f"{kind}.txt").read_text().splitlines()
    return [folder / line.split()[1] for line in lines]


# What a good run does


@pytest.fixture(scope="module")
def good(recording, tmp_path_factory):
    """Return the folder and the outcome of a run over the whole recording, as a user starts it."""
    folder = tmp_path_factory.mktemp("good")
    command = [sys.executable, "-m", "slam", str(recording), "--out", str(folder / "out")]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    return Ran(done.returncode, done.stdout, done.stderr, folder / "out")


def test_a_run_leaves_every_output_and_ends_with_a_table(good):
    assert good.code == 0 and "Traceback" not in good.err
    assert names(good.folder) == OUTPUTS
    starts = [line.split()[0] for line in good.out.splitlines() if not line.startswith(" ")]
    assert starts[:6] == ["camera", "frames", "keyframes", "recognizer", "loops", "ATE"]
    assert starts[-1] == "report"
    assert good.frames.split(maxsplit=1)[1] == "60 of 60 tracked"
    assert str(good.folder / "report.html") in good.out
    summary = json.loads((good.folder / "summary.json").read_text())
    assert summary["frames_tracked"] == 60 and summary["ate_corrected_m"] < 0.02


def test_what_is_read_is_told_on_stderr(good, recording):
    told, *once = good.err.splitlines()  # no bar, for nobody watches
    assert told == f"reading {recording}"
    assert all(line.startswith("compiling") for line in once)
    assert "reading" not in good.out


def test_the_wait_for_the_compiler_is_told_once(monkeypatch, capsys):
    def run(_):
        numba.njit(lambda number: number)(1)
        numba.njit(lambda number: number)(1.0)

    monkeypatch.setattr("slam.__main__._run", run)
    assert main(["anything"]) == 0
    assert capsys.readouterr().err.startswith("compiling the inner loops")
    assert main(["anything", "-q"]) == 0
    assert capsys.readouterr().err == ""


def test_the_time_to_read_is_a_stage_too(good):
    summary = json.loads((good.folder / "summary.json").read_text())
    stages = ["read", "track", "describe", "close loops", "correct", "graph", "adjust"]
    assert list(summary["stage_seconds"]) == stages


def test_a_second_run_gives_the_same_bytes_from_its_own_settings(run_slam, recording, good):
    again = run_slam(recording, "--config", good.folder / "settings.toml")
    assert again.code == 0
    for name in set(OUTPUTS) - {"summary.json", "report.html"}:  # those tell the time it took
        assert (again.folder / name).read_bytes() == (good.folder / name).read_bytes(), name


@pytest.mark.usefixtures("run_slam")  # for its empty folder
def test_without_out_the_outputs_go_to_runs(short_recording, tmp_path):
    assert main([str(short_recording(4)), *QUICK]) == 0
    assert names(tmp_path / "runs") == ["short"]
    assert "report.html" in names(tmp_path / "runs" / "short")


def test_a_map_is_left_out_where_it_is_not_wanted(short_recording, run_slam):
    ran = run_slam(short_recording(4), "--map.write", "False")
    assert names(ran.folder) == [name for name in OUTPUTS if name != "map.ply"]


def test_a_map_is_saved_where_it_is_asked_for(short_recording, run_slam, tmp_path):
    recording = short_recording(6)
    assert run_slam(recording, *QUICK, "--save", "maps/room").code == 0
    assert names(tmp_path / "maps" / "room")[1:] == ["manifest.json"]
    (tmp_path / "maps" / "mine.txt").touch()
    ran = run_slam(recording, *QUICK, "--save", "maps", out="other")
    assert "holds a mine.txt, which is of no map" in ran.complaint and names(ran.folder) == []


def test_a_run_whose_map_cannot_be_saved_is_there_all_the_same(
    short_recording, run_slam, monkeypatch
):
    def fail(*_):
        raise SlamError("the disk is full: maps")

    monkeypatch.setattr(ending, "save_map", fail)
    ran = run_slam(short_recording(6), *QUICK, "--save", "maps")
    assert ran.complaint == "the map is not saved: the disk is full: maps"
    assert names(ran.folder) == [name for name in OUTPUTS if name != "map.ply"]


def test_the_demo_is_rendered_once_into_the_run(monkeypatch, short_recording, run_slam):
    rendered = short_recording(6)

    def render(path, progress):
        shutil.copytree(rendered, path)
        progress(6, 6)

    monkeypatch.setattr("slam.demo.separate_process.render_apart", render)
    first = run_slam("demo", *QUICK)
    assert first.code == 0 and "6 of 6 tracked" in first.out
    assert (first.folder / "sequence" / "rgb.txt").is_file()
    monkeypatch.setattr("slam.demo.separate_process.render_apart", None)
    assert run_slam("demo", *QUICK).code == 0


def test_a_short_name_finds_the_local_copy(monkeypatch, short_recording, run_slam, tmp_path):
    short_recording(4, name="rgbd_dataset_freiburg1_desk")
    monkeypatch.setenv("LOOPCLOSE_DATA", str(tmp_path))
    assert "4 of 4 tracked" in run_slam("fr1_desk", *QUICK).out


@pytest.mark.parametrize("count", [1, 2])
def test_hardly_any_frames_are_a_run_without_a_verdict(short_recording, run_slam, count):
    ran = run_slam(short_recording(count), is_rendered=True)
    assert names(ran.folder) == OUTPUTS
    assert any("no ATE can be given" in warning for warning in ran.warnings)


def test_a_run_in_which_next_to_nothing_was_placed_is_no_good_one(short_recording, run_slam):
    folder = short_recording(40)
    for image in sorted((folder / "rgb").iterdir())[2:]:
        cv2.imwrite(str(image), np.zeros((240, 320, 3), np.uint8))
    ran = run_slam(folder, *QUICK)
    assert "only 2 of 40 frames could be placed" in ran.complaint
    assert len(read_tum(ran.folder / "trajectory.txt")) == 2


def test_help_is_quick_because_it_loads_nothing_heavy(tmp_path):
    script = (
        "import sys\n"
        "from slam.__main__ import main\n"
        "try:\n"
        "    main(['--help'])\n"
        "except SystemExit as exited:\n"
        "    print(exited.code, sorted(sys.modules), file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0 and "usage: run_slam" in done.stdout
    assert done.stderr.startswith("0 ")
    for heavy in ("torch", "open3d", "gtsam", "cv2", "matplotlib", "scipy", "sklearn"):
        assert f"'{heavy}'" not in done.stderr


def test_a_disk_too_full_for_images_of_keyframes_ends_the_run_with_what_was_done(
    short_recording, run_slam, monkeypatch
):
    write, calls = os.pwrite, []

    def fills_up(*arguments):
        calls.append(arguments)
        if len(calls) > 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        return write(*arguments)

    monkeypatch.setattr(os, "pwrite", fills_up)
    ran = run_slam(short_recording(40), "--keyframes.memory-mb", 0)
    assert ran.complaint.startswith("cannot keep what keyframes show: No space left on device;")
    assert "what was done until then is in" in ran.complaint
    assert set(names(ran.folder)) >= set(OUTPUTS)
    assert len(read_tum(ran.folder / "trajectory.txt")) > 0


def test_tracking_loads_no_library_that_only_outputs_or_learning_need(short_recording):
    script = (
        "import sys\n"
        "from slam import __main__ as cli\n"
        "from slam.output import ending\n"
        "def conclude(*_):\n"
        "    print(*sys.modules)\n"
        "    sys.exit(7)\n"
        "ending.conclude = conclude\n"
        "cli.main(sys.argv[1:])\n"
    )
    folder = short_recording()
    done = subprocess.run(
        [sys.executable, "-c", script, str(folder), "--out", str(folder / "out")],
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 7, done.stderr
    loaded = set(done.stdout.split())
    assert "slam.tracking.odometry" in loaded
    idle = {"torch", "open3d", "matplotlib", "PIL", "jinja2", "scipy.stats", "scipy.optimize"}
    assert not idle & loaded


# Several sequences


def later(folder, seconds):
    """Move a recording in time."""
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        split = [line.split(" ", 1) for line in (folder / name).read_text().splitlines()]
        lines = [f"{float(time_s) + seconds:.6f} {rest}\n" for time_s, rest in split]
        (folder / name).write_text("".join(lines))
    return folder


def test_two_recordings_make_one_map(run_slam, short_recording):
    first, second = short_recording(26, name="first"), later(short_recording(28, "second"), 60.0)
    ran = run_slam(first, second)
    assert ran.code == 0 and "54 of 54 tracked" in ran.frames
    assert names(ran.folder) == OUTPUTS
    times_s = read_tum(ran.folder / "trajectory.txt").timestamps_s
    assert len(times_s) == 54 and times_s[26] - times_s[25] > 50.0
    assert len(read_tum(ran.folder / "groundtruth.txt")) == 120  # 60 of each
    summary = json.loads((ran.folder / "summary.json").read_text())
    assert (summary["sessions"], summary["segments"]) == (2, 2)
    assert summary["ate_corrected_m"] < 0.02 and summary["truth_coverage"] > 0.9
    assert f"run_slam {first} {second} --rec" in (ran.folder / "settings.toml").read_text()
    assert "<h1>first+second</h1>" in (ran.folder / "report.html").read_text()
    assert any("one frame of reference" in warning for warning in ran.warnings)


def test_recordings_in_the_wrong_order_are_refused(run_slam, short_recording):
    first, second = short_recording(4, name="first"), later(short_recording(4, "second"), 60.0)
    ran = run_slam(second, first)
    assert "put first, which ends at" in ran.complaint
    assert not ran.folder.exists()


@pytest.mark.usefixtures("run_slam")  # for its empty folder
def test_without_out_several_recordings_go_to_a_folder_of_both_names(short_recording, tmp_path):
    paths = [short_recording(4, name="first"), later(short_recording(4, "second"), 60.0)]
    assert main([*map(str, paths), *QUICK]) == 0
    assert names(tmp_path / "runs") == ["first+second"]


# Sequences that cannot be read


def test_a_folder_that_is_not_there(run_slam, tmp_path):
    ran = run_slam(tmp_path / "nowhere")
    assert str(tmp_path / "nowhere") in ran.complaint
    assert not ran.folder.exists()  # a typing error leaves nothing to clear away


def test_a_misspelt_short_name(run_slam):
    assert "fr1_desk" in run_slam("fr1_desc").complaint


def test_a_folder_that_is_no_recording(run_slam, tmp_path):
    (tmp_path / "photos").mkdir()
    assert "no recording in a known format" in run_slam(tmp_path / "photos").complaint


@pytest.mark.parametrize(
    ("name", "change", "told"),
    [
        ("rgb.txt", lambda lines: [], "names no image"),
        ("rgb.txt", lambda lines: ["# nothing"], "names no image"),
        ("depth.txt", lambda lines: [*lines, "soon depth/1.png"], "line 5"),
        ("depth.txt", lambda lines: [f"9{line}" for line in lines], "close enough in time"),
        ("groundtruth.txt", lambda lines: [*lines, "1 2 3"], "line 61"),
        ("groundtruth.txt", lambda lines: ["100 0 0 0 0 0 0 1e-9"], "length zero"),
        ("camera.toml", lambda lines: ["fx = "], "not valid TOML"),
        ("camera.toml", lambda lines: [*lines[2:]], "is missing"),
        ("camera.toml", lambda lines: [*lines[1:], "width = 640"], "320x240"),
        ("camera.toml", lambda lines: [*lines[1:], "width = -320"], "width = -320"),
    ],
)
def test_a_list_or_camera_that_is_wrong(run_slam, short_recording, name, change, told):
    folder = short_recording(4)
    edit(folder / name, change)
    ran = run_slam(folder)
    assert told in ran.complaint
    assert not ran.folder.exists()


def test_no_depth_near_in_time_tells_the_tolerance(run_slam, short_recording):
    folder = short_recording(4)
    edit(folder / "depth.txt", lambda lines: [line.replace(".", ".05", 1) for line in lines])
    complaint = run_slam(folder, "--input.max-time-difference-s", "0.001").complaint
    assert "0.001 s" in complaint and "--input.max-time-difference-s" in complaint


def test_unsorted_and_duplicated_lists_are_mended_and_told(run_slam, short_recording):
    folder = short_recording(6)
    edit(folder / "rgb.txt", lambda lines: [*lines[::-1], lines[2]])
    ran = run_slam(folder, *QUICK)
    assert "6 of 6 tracked" in ran.frames
    assert [w for w in ran.warnings if "rgb.txt is not in the order of time" in w]
    assert [w for w in ran.warnings if "1 line(s) that came before" in w]


@pytest.mark.parametrize("kind", ["rgb", "depth"])
@pytest.mark.parametrize("spoil", [Path.unlink, cut_off, lambda path: path.write_bytes(b"")])
def test_a_broken_image_is_skipped_and_counted(run_slam, short_recording, kind, spoil):
    folder = short_recording(8)
    spoil(images(folder, kind)[3])
    ran = run_slam(folder, *QUICK)
    assert "7 of 7 tracked" in ran.frames
    (warning,) = [w for w in ran.warnings if "skipped" in w]
    assert warning.startswith("1 of 8 frames") and str(images(folder, kind)[3]) in warning


def test_more_than_half_missing(run_slam, short_recording):
    folder = short_recording(8)
    for path in images(folder, "rgb")[:5]:
        path.unlink()
    assert "more than half of the 8 frames" in run_slam(folder).complaint


def test_more_than_half_broken_keeps_what_came_before(run_slam, short_recording):
    folder = short_recording(12)
    for path in images(folder, "rgb")[5:]:
        cut_off(path)
    ran = run_slam(folder)
    assert "more than half of the 12 frames" in ran.complaint
    assert f"what was done until then is in {ran.folder.name}" in ran.complaint
    assert names(ran.folder) == OUTPUTS
    assert len(read_tum(ran.folder / "trajectory.txt")) == 5


def shrink(path):
    depth = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    cv2.imwrite(str(path), depth[:-2])


def test_depth_of_another_size(run_slam, short_recording):
    folder = short_recording(4)
    for path in images(folder, "depth"):
        shrink(path)
    complaint = run_slam(folder).complaint
    assert "320x238 pixels but its colour image 320x240" in complaint


def test_one_depth_image_of_another_size_keeps_what_came_before(run_slam, short_recording):
    folder = short_recording(12)
    shrink(images(folder, "depth")[9])
    ran = run_slam(folder, *QUICK)
    assert "320x238 pixels" in ran.complaint and "what was done until then" in ran.complaint
    assert 1 <= len(read_tum(ran.folder / "trajectory.txt")) <= 9


def test_images_without_anything_to_see(run_slam, short_recording):
    folder = short_recording(4)
    for path in images(folder, "rgb"):
        cv2.imwrite(str(path), np.zeros((240, 320, 3), np.uint8))
    ran = run_slam(folder)
    assert "no frame could be tracked" in ran.complaint
    assert names(ran.folder) == []


# Ground truth and settings to doubt


def test_without_truth_it_runs_and_says_calmly_that_the_error_is_not_known(
    run_slam, short_recording
):
    folder = short_recording(6)
    (folder / "groundtruth.txt").unlink()
    ran = run_slam(folder)
    assert not any("truth" in warning for warning in ran.warnings)
    assert "error      not known: no ground truth to compare with" in ran.out
    assert names(ran.folder) == [name for name in OUTPUTS if name != "groundtruth.txt"]
    assert "ATE   " not in ran.out
    assert json.loads((ran.folder / "summary.json").read_text())["ate_corrected_m"] is None


def test_truth_of_another_time_is_as_good_as_none(run_slam, short_recording):
    folder = short_recording(6)
    edit(folder / "groundtruth.txt", lambda lines: [f"9{line}" for line in lines])
    ran = run_slam(folder, *QUICK)
    assert any("no ATE can be given: only 0 of 6 poses" in warning for warning in ran.warnings)


def test_truth_of_a_part_is_compared_there_and_the_share_told(run_slam, short_recording):
    folder = short_recording(12)
    edit(folder / "groundtruth.txt", lambda lines: lines[:6])
    ran = run_slam(folder, *QUICK)
    assert (
        ran.code == 0
        and "over 50.0% of the tracked frames" in ran.out
        and "covers 45.5%" in ran.out
    )


def test_a_depth_scale_that_cannot_be_right_is_doubted_with_what_was_seen(
    run_slam, short_recording
):
    ran = run_slam(short_recording(6), "--input.depth-scale", "100000", *QUICK)
    (doubt,) = [warning for warning in ran.warnings if "median depth" in warning]
    assert "100000 units per metre" in doubt and "--input.depth-scale 5000" in doubt


def test_a_depth_scale_that_cannot_be_right_is_doubted(run_slam, short_recording):
    ran = run_slam(short_recording(6), "--input.depth-scale", "50", *QUICK)
    assert ran.code == 0 and "6 of 6 tracked" in ran.frames  # no size of the world is too large
    assert "median depth" in ran.err and "--input.depth-scale 5000" in ran.err


def test_intrinsics_that_cannot_be_right_are_doubted(run_slam, short_recording):
    folder = short_recording(6)
    camera = read_camera(folder / "camera.toml")
    write_camera(folder / "odd.toml", type(camera)(**{**vars(camera), "fx": 30.0}))
    ran = run_slam(folder, "--input.camera", folder / "odd.toml", *QUICK)
    assert "field of view of 159 degrees" in ran.err
    assert ran.code == 0 or ran.complaint


# Recognizers


@pytest.fixture
def recognizer(tmp_path, request):
    """Write a recognizer that answers well for some keyframes and then no more."""
    name = f"places_{abs(hash(request.node.name))}"

    def write(then, good=2):
        (tmp_path / f"{name}.py").write_text(
            "import os, signal, time\n"
            "import numpy as np\n"
            "class Mine:\n"
            "    min_similarity = 0.5\n"
            "    seen = 0\n"
            "    def embed(self, image):\n"
            "        self.seen += 1\n"
            f"        if self.seen > {good}:\n"
            f"            {then}\n"
            "        return np.array([0.6, 0.8], np.float32)\n"
        )
        return f"{name}:Mine"

    yield write
    sys.modules.pop(name, None)


def test_an_unknown_recognizer(run_slam, short_recording):
    ran = run_slam(short_recording(4), "--recognizer", "gradient")
    assert "no recognizer 'gradient'" in ran.complaint
    assert not ran.folder.exists()


@pytest.mark.parametrize("name", ["nowhere:Mine", "json:nothing", "a b:c", "json:dumps"])
def test_a_recognizer_that_cannot_be_had(run_slam, short_recording, name):
    assert "recognizer" in run_slam(short_recording(4), "--recognizer", name).complaint


@pytest.mark.parametrize(
    ("then", "told"),
    [
        ("return np.array([np.nan, 1.0])", "NaN or infinite"),
        ("return np.eye(2)", "shape (2, 2)"),
        ("return np.array([0.0, 0.6, 0.8])", "shape (3,) after (2,)"),
        ("return np.array([3.0, 4.0])", "length 5"),
        ("raise ValueError('no more memory')", "ValueError: no more memory"),
    ],
)
def test_a_recognizer_that_fails_late_costs_only_what_comes_after(
    run_slam, recording, recognizer, then, told
):
    ran = run_slam(recording, "--recognizer", recognizer(then), *QUICK)
    assert told in ran.complaint and "'Mine'" in ran.complaint
    lacking = ("map.ply", "measurements.npz")
    assert names(ran.folder) == [name for name in OUTPUTS if name not in lacking]
    assert "replay cannot decide about this run again: of 10 keyframes that were" in ran.out
    assert len(read_tum(ran.folder / "keyframes.txt")) == 2
    assert f"stopped early: {ran.complaint.split(';')[0]}" in ran.out


def test_a_recognizer_that_fails_near_the_end_is_no_good_run(run_slam, short_recording, recognizer):
    mine = recognizer("raise ValueError('no more memory')")
    ran = run_slam(short_recording(16, "two words"), "--recognizer", mine, *QUICK)
    assert "no more memory; what was done until then" in ran.complaint
    assert len(read_tum(ran.folder / "keyframes.txt")) == 2
    tracked = len(read_tum(ran.folder / "trajectory.txt"))
    assert tracked < 16 and f"{tracked} of 16 tracked" in ran.frames
    assert "two words'" in (ran.folder / "settings.toml").read_text().splitlines()[0]


def test_a_recognizer_that_fails_at_once_leaves_nothing(run_slam, recording, recognizer):
    ran = run_slam(recording, "--recognizer", recognizer("return None", good=0))
    assert "shape ()" in ran.complaint
    assert names(ran.folder) == []


@pytest.fixture
def weights(tmp_path):
    """Write a small network that was never trained."""
    path = tmp_path / "places.safetensors"
    network = PlaceNetwork(TRUNKS["mobilenet_v2"], 4, block="stem", grid=(2, 2), size_px=(48, 36))
    save_weights(network, path, 0.25)
    return path


@pytest.fixture
def certify(weights, certificate):
    """Return a function that puts a certificate beside the weights."""
    (kind,) = certificate.kinds
    room = {"data": "some rooms", "different_places": (0.0, 0.5), "same_place": (0.0, 0.5)}
    mine = {"recognizer": weights.name, "fingerprint": LearnedRecognizer(weights).fingerprint}

    def keep(fingerprint=mine["fingerprint"], **changes):
        kinds = (kind.model_copy(update=room | changes),)
        found = mine | {"kinds": kinds, "fingerprint": fingerprint}
        keep_calibration(weights, certificate.model_copy(update=found))

    return keep


def test_weights_are_used_with_what_they_were_calibrated_on(
    run_slam, short_recording, weights, certify
):
    command = (short_recording(4), "--recognizer", weights, *QUICK)
    assert "verifies from similarity 0.250, without a certificate\n" in run_slam(*command).out
    certify()
    ran = run_slam(*command)
    assert "verifies from similarity 0.500, calibrated on some rooms (" in ran.out
    summary = json.loads((ran.folder / "summary.json").read_text())
    assert summary["certificate"]["recognizer"] == "places.safetensors"
    assert "some rooms" in (ran.folder / "report.html").read_text()


def test_places_unlike_those_calibrated_on_are_warned_of(
    run_slam, short_recording, weights, certify, monkeypatch
):
    monkeypatch.setattr(certificates, "_FEW_PAIRS", 1)
    certify(same_place=(-1.0, -0.5))
    ran = run_slam(short_recording(34), "--recognizer", weights, *QUICK)
    (warning,) = ran.warnings
    assert "similarities" in warning and "calibrated on some rooms" in warning
    assert html.escape(warning) in (ran.folder / "report.html").read_text()


def test_a_certificate_of_other_weights_is_refused(run_slam, short_recording, weights, certify):
    certify(fingerprint="sha256:0")
    complaint = run_slam(short_recording(4), "--recognizer", weights).complaint
    assert complaint.startswith("the certificate is of other weights than places.safetensors; ")


@pytest.mark.parametrize("content", [b"", b"cos\nsystem\n(S'true'\ntR.", None])
def test_weights_that_cannot_be_used(run_slam, short_recording, weights, content):
    weights.write_bytes(weights.read_bytes()[:-100] if content is None else content)
    complaint = run_slam(short_recording(4), "--recognizer", weights).complaint
    assert complaint.startswith("the weights are not a whole safetensors file (")


# Interruptions


def test_ctrl_c_finishes_the_frame_and_writes_what_there_is(run_slam, recording, recognizer):
    # The frame is a keyframe: its links and loops still come into the graph.
    mine = recognizer("os.kill(os.getpid(), signal.SIGINT)", good=3)
    before = signal.getsignal(signal.SIGINT)
    ran = run_slam(recording, "--recognizer", mine)
    assert ran.complaint == f"interrupted; what was done until then is in {ran.folder.name}"
    assert names(ran.folder) == OUTPUTS
    assert len(read_tum(ran.folder / "keyframes.txt")) == 4
    assert "warning    the run stopped early: interrupted" in ran.out
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_twice_does_not_wait_for_the_frame(run_slam, recording, recognizer):
    # Places are described in a thread of their own; two signals at once would count as one.
    twice = "[(os.kill(os.getpid(), signal.SIGINT), time.sleep(0.5)) for _ in range(2)]"
    mine = recognizer(twice, good=3)
    before = signal.getsignal(signal.SIGINT)
    ran = run_slam(recording, "--recognizer", mine)
    told = (
        "interrupted before the outputs were complete; run_slam out --finish makes the outputs of"
    )
    assert ran.complaint == f"{told} what was done until then"
    assert signal.getsignal(signal.SIGINT) is before


def test_ctrl_c_from_a_terminal(recording, tmp_path):
    command = [sys.executable, "-m", "slam", str(recording), "--out", "out"]
    places = (
        "import pathlib, time\n"
        "import numpy as np\n"
        "class Slow:\n"
        "    min_similarity = 0.5\n"
        "    def embed(self, image):\n"
        "        pathlib.Path('started').touch()\n"
        "        time.sleep(0.3)\n"
        "        return np.array([0.6, 0.8], np.float32)\n"
    )
    (tmp_path / "slow_places.py").write_text(places)
    process = subprocess.Popen(
        [*command, "--recognizer", "slow_places:Slow"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while not (tmp_path / "started").exists() and process.poll() is None:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate()
    ran = Ran(process.returncode, out, err, tmp_path / "out")
    assert ran.complaint == "interrupted; what was done until then is in out"
    assert names(ran.folder) == OUTPUTS


def fails_at(monkeypatch, number, step):
    """Let tracking do something else with a frame."""
    track, calls = RgbdOdometry.track, iter(range(10_000))
    monkeypatch.setattr(
        RgbdOdometry,
        "track",
        lambda *arguments: step() if next(calls) == number else track(*arguments),
    )


def no_memory():
    return np.empty(10**15)


def no_thread():
    raise RuntimeError("can't start new thread")


def bad_image():
    return cv2.resize(np.zeros((0, 0)), (4, 4))


@pytest.mark.parametrize(
    ("step", "told"),
    [
        (no_memory, "MemoryError: Unable to allocate 7.11 PiB"),
        (no_thread, "RuntimeError: can't start new thread"),
        (bad_image, "error: OpenCV"),
        (lambda: sys.exit, "AttributeError"),  # any other mistake
    ],
)
def test_whatever_fails_keeps_what_was_done_until_then(
    run_slam, short_recording, monkeypatch, step, told
):
    fails_at(monkeypatch, 8, step)
    ran = run_slam(short_recording(12))
    assert told in ran.complaint and f"done until then is in {ran.folder.name}" in ran.complaint
    assert names(ran.folder) == OUTPUTS
    assert len(read_tum(ran.folder / "trajectory.txt")) >= 7


@pytest.mark.parametrize(("part", "stage"), [(BackEnd, "solve"), (LoopCloser, "similarities")])
def test_a_stage_that_fails_in_the_end_does_not_cost_the_others(
    run_slam, short_recording, monkeypatch, part, stage
):
    monkeypatch.setattr(part, stage, lambda *_: no_memory())
    ran = run_slam(short_recording(12))
    assert "is missing: MemoryError" in ran.complaint
    assert names(ran.folder) == OUTPUTS
    assert len(read_tum(ran.folder / "trajectory.txt")) == 12


def test_a_judgement_that_fails_is_a_run_without_one(run_slam, short_recording, monkeypatch):
    monkeypatch.setattr(ending, "compare_drift", lambda *_: no_memory())
    ran = run_slam(short_recording(6), *QUICK)
    assert "the comparison with ground truth is missing: MemoryError" in ran.complaint
    assert names(ran.folder) == [name for name in OUTPUTS if name != "map.ply"]


def test_an_output_folder_that_is_deleted_is_made_again(run_slam, short_recording, monkeypatch):
    fails_at(monkeypatch, 8, lambda: shutil.rmtree("out"))
    ran = run_slam(short_recording(12))
    assert ran.code == 2
    assert names(ran.folder) == [name for name in OUTPUTS if name != "measurements.npz"]


def test_two_runs_do_not_share_a_folder(run_slam, short_recording, tmp_path):
    with ClaimedFolder(tmp_path / "out"):
        ran = run_slam(short_recording(4))
        assert "another run is writing into the output folder" in ran.complaint


def test_a_name_that_is_not_utf_8_is_no_reason_to_fail(short_recording, tmp_path):
    folder, out = short_recording(6, os.fsdecode(b"caf\xe9")), tmp_path / "out"
    # In a process of its own: pytest cannot hand what was said of it from one process to another.
    ran = subprocess.run([sys.executable, "-m", "slam", folder, "--out", out], capture_output=True)
    assert ran.returncode == 0 and names(out) == OUTPUTS
    assert load_config(out / "settings.toml") == Config()


def test_a_lens_that_throws_points_away_costs_no_more_than_points(run_slam, short_recording):
    folder = short_recording(8)
    camera = read_camera(folder / "camera.toml")
    for distortion in ((0.0, 0.0, 0.0, -1.0, 0.0), (1e6, -1e9, 0.0, 0.0, 1e12)):
        write_camera(folder / "camera.toml", replace(camera, distortion=distortion))
        ran = run_slam(folder)
        assert ran.code == 0 or ran.complaint


@pytest.fixture
def started(recording, tmp_path):
    """Start runs that take a while, each in its own process, and wait until they are going on."""
    processes = []

    def start(*arguments):
        (tmp_path / "slow_places.py").write_text(
            "import time\nimport numpy as np\n"
            "class Slow:\n    min_similarity = 0.5\n"
            "    def embed(self, image):\n        time.sleep(0.4)\n"
            "        return np.array([0.6, 0.8], np.float32)\n"
        )
        command = [sys.executable, "-m", "slam", str(recording), "--out", "out", *arguments]
        process = subprocess.Popen(
            [*command, "--recognizer", "slow_places:Slow"],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        processes.append(process)
        so_far = tmp_path / "out" / "unfinished" / "trajectory.txt"
        deadline = time.monotonic() + 60.0
        while time.monotonic() < deadline and process.poll() is None:
            if so_far.exists() and len(so_far.read_text().splitlines()) > 5:
                break
            time.sleep(0.02)
        return process

    yield start
    for process in processes:
        process.kill()
        process.communicate()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_termination_does_what_ctrl_c_does(started, tmp_path, number):
    process = started()
    process.send_signal(number)
    process.send_signal(number)
    out, err = process.communicate()
    ran = Ran(process.returncode, out, err, tmp_path / "out")
    assert ran.complaint == "interrupted; what was done until then is in out"
    assert names(ran.folder) == OUTPUTS


@pytest.mark.parametrize("flags", [["--live"], ["--rrd", "a.rrd"], ["--map", "mesh"]])
def test_what_a_killed_run_left_cannot_show_images(capsys, tmp_path, flags):
    assert "a killed run has none" in refuse([str(tmp_path), "--finish", *flags], capsys)


def test_what_a_killed_run_left_is_finished(started, run_slam, tmp_path):
    process = started()
    process.kill()
    process.communicate()
    out = tmp_path / "out"
    assert names(out) == ["unfinished"]
    so_far = read_tum(out / "unfinished" / "trajectory.txt")
    ran = run_slam("out", "--finish", out="unused")
    assert ran.code == 0 and "made of what a run had left" in ran.out
    assert names(out) == [name for name in OUTPUTS if name != "map.ply"]
    assert len(read_tum(out / "trajectory.txt")) >= len(so_far) > 5
    assert json.loads((out / "summary.json").read_text())["ate_corrected_m"] < 0.05
    again = run_slam("out", "--finish", out="unused")
    assert again.code == 0 and "is complete" in again.err


def test_what_a_killed_run_left_is_finished_with_its_poses_from_elsewhere(
    started, run_slam, recording, tmp_path
):
    process = started("--odometry", str(recording / "groundtruth.txt"))
    process.kill()
    process.communicate()
    assert run_slam("out", "--finish", out="unused").code == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert 5 < summary["given_poses"] <= 60 and summary["given_verdict"]
    assert "corrected_odometry.txt" in names(tmp_path / "out")


@pytest.mark.parametrize("folder", ["nowhere", "."])
def test_where_nothing_was_left_there_is_nothing_to_finish(run_slam, tmp_path, folder):
    assert "nothing unfinished" in run_slam(folder, "--finish", out="unused").complaint
    assert not (tmp_path / "nowhere").exists()


# Outputs that cannot be written


@pytest.mark.parametrize("out", ["taken", "taken/deeper"])
def test_an_output_folder_that_cannot_be(run_slam, short_recording, tmp_path, out):
    (tmp_path / "taken").write_text("mine")
    complaint = run_slam(short_recording(4), out=out).complaint
    assert "cannot write to the output folder" in complaint and complaint.endswith(out)
    assert (tmp_path / "taken").read_text() == "mine"


def test_a_recording_is_never_written_into(run_slam, short_recording, tmp_path):
    folder = short_recording(4)
    truth = (folder / "groundtruth.txt").read_bytes()
    (tmp_path / "link").symlink_to(folder)
    for out in (folder, tmp_path / "link", "short/../short"):
        assert "replace files of the recording" in run_slam(folder, out=out).complaint
    assert (folder / "groundtruth.txt").read_bytes() == truth
    assert "trajectory.txt" not in names(folder)


def test_ctrl_c_while_the_run_is_written_waits_for_it(run_slam, short_recording, monkeypatch):
    finish = Slam.finish

    def interrupted_finish(slam):
        os.kill(os.getpid(), signal.SIGINT)
        return finish(slam)

    monkeypatch.setattr(Slam, "finish", interrupted_finish)
    ran = run_slam(short_recording(6))
    assert ran.code == 0
    assert names(ran.folder) == OUTPUTS


def test_a_full_disk_keeps_what_was_written(run_slam, short_recording, monkeypatch):
    import_module("slam.output.report.page")  # loaded later, it would keep what is patched
    write, left = files.write_atomically, iter(range(5))

    def fills_up(path, data):
        if "unfinished" in path.parts and path.suffix != ".toml" and next(left, None) is None:
            raise SlamError(f"cannot write {path.name}: No space left on device")
        write(path, data)

    for module in list(sys.modules.values()):
        if getattr(module, "write_atomically", None) is write:
            monkeypatch.setattr(module, "write_atomically", fills_up)
    ran = run_slam(short_recording(6))
    assert "No space left on device" in ran.complaint and "report.html" in ran.complaint
    assert {"trajectory.txt", "odometry.txt"} < set(names(ran.folder)) < set(OUTPUTS)
    assert len(read_tum(ran.folder / "trajectory.txt")) == 6


# Arguments and settings


def settings_file(tmp_path, text):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    return path


def refuse(arguments, capsys):
    """Return the one line by which arguments are refused."""
    assert main(arguments) == 2
    printed = capsys.readouterr()
    assert printed.out == "" and printed.err.count("\n") == 1
    return printed.err.removeprefix("run_slam: ")


def test_a_sequence_is_all_that_is_needed():
    arguments = parse(["fr1_desk"])
    assert arguments.sequences == ("fr1_desk",) and arguments.title == "fr1_desk"
    assert arguments.out is None and arguments.config is None
    assert arguments.settings == Config()


def test_several_sequences_are_one_run(tmp_path):
    arguments = parse(["fr1_xyz", str(tmp_path / "later"), "--map.write", "False"])
    assert arguments.sequences == ("fr1_xyz", str(tmp_path / "later"))
    assert arguments.title == "fr1_xyz+later"
    for words in (["--out", "here", "a", "b", "c"], ["a", "--out", "here", "b", "c"]):
        assert parse(words).sequences == ("a", "b", "c")


def test_the_sequence_may_come_last():
    arguments = parse(["--out", "here", "--recognizer", "mine", "fr1_desk"])
    assert (arguments.sequence, arguments.out, arguments.recognizer) == (
        "fr1_desk",
        Path("here"),
        "mine",
    )


@pytest.mark.parametrize("name", ["min-inliers", "min_inliers"])
def test_a_setting_is_a_flag_named_by_section_and_option(name):
    arguments = parse(["demo", f"--verification.{name}", "40", "--map.write", "False"])
    assert arguments.settings.verification.min_inliers == 40
    assert arguments.settings.map.write is False
    changed = Config().model_copy(
        update={
            "verification": Config().verification.model_copy(update={"min_inliers": 40}),
            "map": Config().map.model_copy(update={"write": False}),
        }
    )
    assert arguments.settings == changed


@pytest.mark.parametrize(
    ("typed", "write", "mesh"),
    [("points", True, False), ("mesh", True, True), ("none", False, False)],
)
def test_the_map_is_chosen_by_its_kind(typed, write, mesh):
    arguments = parse(["demo", "--map", typed, "--map.voxel-m", "0.02"])
    of_map = Config().map.model_copy(update={"write": write, "mesh": mesh, "voxel_m": 0.02})
    assert arguments.settings == Config().model_copy(update={"map": of_map})


def test_settings_without_a_default_can_be_given():
    arguments = parse(["x", "--input.camera", "cam.toml", "--loop.min-similarity", "0.5"])
    assert arguments.settings.input.camera == Path("cam.toml").absolute()
    assert arguments.settings.loop.min_similarity == 0.5


@pytest.mark.parametrize("style", ["--config {}", "--config={}"])
def test_flags_win_over_the_file_and_the_file_over_the_defaults(tmp_path, style):
    path = settings_file(
        tmp_path, "[verification]\nmin_inliers = 40\nmin_matches = 30\n[map]\nwrite = false\n"
    )
    flags = ["--verification.min-inliers", "50"]
    arguments = parse(["demo", *style.format(path).split(), *flags])
    verification = arguments.settings.verification
    assert (verification.min_inliers, verification.min_matches) == (50, 30)
    assert verification.ransac_iterations == Config().verification.ransac_iterations
    assert arguments.settings.map.write is False
    assert arguments.config == path


def test_written_settings_give_the_same_settings(tmp_path):
    first = parse(["demo", "--input.depth-scale", "1000", "--odometry.links", "2"]).settings
    path = settings_file(tmp_path, to_toml(first))
    assert parse(["demo", "--config", str(path)]).settings == first


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[verification\n", "not valid TOML"),
        ("[verification]\nmin_inlers = 3\n", r"no setting verification\.min_inlers"),
        ("[verifikation]\nmin_inliers = 3\n", "no setting verifikation"),
        ("[verification]\nmin_inliers = 0\n", r"verification\.min_inliers = 0: .*greater than 0"),
        ("[map]\nwrite = 'perhaps'\n", r"map\.write = 'perhaps'"),
        ("[loop]\nmin_similarity = nan\n", r"loop\.min_similarity = nan"),
        ("map = 3\n", "map = 3"),
    ],
)
def test_a_bad_settings_file_is_one_line_that_names_it(tmp_path, text, message):
    path = settings_file(tmp_path, text)
    with pytest.raises(SlamError, match=message) as error:
        parse(["demo", "--config", str(path)])
    assert "\n" not in str(error.value) and str(error.value).endswith(str(path))


def test_a_settings_file_that_is_not_there_is_one_line(tmp_path):
    with pytest.raises(SlamError, match=r"cannot read the settings file: .*none\.toml"):
        parse(["demo", "--config", str(tmp_path / "none.toml")])


@pytest.mark.parametrize(
    ("flags", "told"),
    [
        (["--verification.min-inliers", "0"], "--verification.min-inliers 0: input should be g"),
        (["--verification.min-inliers", "many"], "--verification.min-inliers"),
        (["--loop.min-similarity", "3"], "--loop.min-similarity 3.0: input should be 'adapted' or"),
        (["--map", "surface"], "--map"),
        (["--map.voxel-m", "nan"], "--map.voxel-m nan: input should be"),
        (["--odometry.scale", "-1"], "--odometry.scale -1.0: input should be 'auto' or input sh"),
        (["--odometry.T-base-cam", *"0000000"], "--odometry.T-base-cam 0.0 0.0 0.0 0.0 0.0 0.0"),
        (["--verification.min-inlers", "3"], "perhaps you meant --verification.min-inliers"),
        (["--config"], "--config"),
        (["--completion", "bash"], "--completion"),
        (["-q", "--verbose"], "give one of them"),
    ],
)
def test_a_bad_flag_is_refused_by_the_name_that_was_typed(capsys, flags, told):
    assert told in refuse(["demo", *flags], capsys)


def test_nothing_at_all_asks_for_a_sequence(capsys):
    assert "SEQUENCE" in refuse([], capsys)
    assert "bash, zsh" in refuse(["--completion"], capsys)


def printed_at_exit(arguments, capsys):
    with pytest.raises(SystemExit) as exited:
        main(arguments)
    assert not exited.value.code
    printed = capsys.readouterr()
    assert printed.err == ""
    return printed.out


@pytest.mark.parametrize("flag", ["-h", "--help"])
def test_help_is_one_screen_with_all_that_is_no_setting(capsys, monkeypatch, flag):
    monkeypatch.setenv("COLUMNS", "80")
    lines = printed_at_exit([flag], capsys).splitlines()
    assert len(lines) <= 32 and max(map(len, lines)) <= 80
    begins = {line.split()[0].rstrip(",") for line in lines if line.startswith("  ")}
    assert {"run_slam", "SEQUENCE", "--odometry", "--out", "--recognizer", "--config"} <= begins
    assert {"--help-all", "-h", "-q", "-v", "--version", "--completion"} <= begins
    assert "  --config FILE.toml  TOML file with settings" in lines


def test_help_all_lists_every_setting_with_its_default(capsys):
    text = printed_at_exit(["--help-all"], capsys)
    for section, values in Config().model_dump().items():
        for name in values:
            assert f"--{section}.{name.replace('_', '-')}" in text
    assert "run_slam demo" in text and "(default: 25)" in text and "--completion" in text


def test_the_version_is_that_of_the_package(capsys):
    assert printed_at_exit(["--version"], capsys) == f"run_slam {version('loopclose')}\n"


def test_completion_is_a_script_with_the_flags(capsys):
    assert "--verification.min-inliers" in printed_at_exit(["--completion", "zsh"], capsys)


def test_a_bad_settings_file(run_slam, short_recording, tmp_path):
    (tmp_path / "mine.toml").write_text("[verification]\nmin_inlers = 3\n")
    complaint = run_slam(short_recording(4), "--config", "mine.toml").complaint
    assert "no setting verification.min_inlers" in complaint and complaint.endswith("mine.toml")


# How much is said


def test_quiet_says_nothing_of_a_good_run(run_slam, short_recording):
    ran = run_slam(short_recording(4), "-q", *QUICK)
    assert (ran.code, ran.out, ran.err) == (0, "", "")
    assert "summary.json" in names(ran.folder)


def test_verbose_tells_how_far_it_is_and_what_is_logged(run_slam, short_recording):
    ran = run_slam(short_recording(4), "--verbose", *QUICK)
    told = [line for line in ran.err.splitlines() if line.startswith("tracking: ")]
    assert told == [f"tracking: {n} of 4" for n in (1, 2, 3, 4)]
    assert "\nsegment 0 begins at " in ran.err
    assert ran.out.startswith("camera")


class DrawnAtEachStep(tqdm):
    """Otherwise a bar is drawn anew only if a tenth of a second has passed."""

    def __init__(self, **settings):
        super().__init__(**settings, mininterval=0.0)


def test_a_bar_is_drawn_only_on_a_terminal(run_slam, short_recording, monkeypatch):
    monkeypatch.setattr(console, "tqdm", DrawnAtEachStep)
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("NO_COLOR", "1")
    ran = run_slam(short_recording(4), *QUICK)
    drawn = re.findall(r"tracking: .*?(\d)/4 ", ran.err)
    assert {"1", "2", "3", "4"} <= set(drawn) and "\x1b[3" not in ran.err
    assert "\r" not in run_slam("short", "-q", *QUICK).err
