# SPDX-License-Identifier: Apache-2.0
"""How long loading a large map takes, and what kills leave of one that is being saved.

    python -m benchmarks.large_maps.saved_maps [--keyframes 10000] [--kills 20] [--seed 0]

A map of made-up keyframes, each with 1,000 features and 150 landmarks of its own, is saved, and
loaded three times, in processes of their own. Then a process that saves one of two small maps over
the other is killed at random times; each time the old map or the new has to be there, whole.
"""

import argparse
import random
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from placerec import load
from slam import Camera, Keyframe, SavedMap, load_map, save_map
from slam.geometry.keyframe_memory import kept_frame
from slam.loops.submaps import Loop
from slam.mapping.landmark_map import LandmarkMap, MappedKeyframe
from slam.mapping.landmarks import Landmarks
from slam.types import (
    Features,
    Frame,
    Link,
    LoopAttempt,
    RelativePose,
    Verification,
)

CAMERA = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
RECOGNIZER = "gradients"
FEATURES, LANDMARKS, LENGTH = 1000, 150, 1000
LOAD = """
import sys, time
from pathlib import Path
from placerec import load
from slam import Slam, load_map
recognizer = load(sys.argv[2])
def most_mb():
    lines = Path("/proc/self/status").read_text().splitlines()  # of Linux
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM"))
before_mb, start_s = most_mb(), time.perf_counter()
of_core_s = time.process_time()
loaded = load_map(Path(sys.argv[1]), recognizer)
took_s, loaded_mb = time.perf_counter() - start_s, most_mb()
slam = Slam(loaded.camera, recognizer, earlier=loaded, is_fixed=True)
ready_s = time.perf_counter() - start_s
of_core_s = time.process_time() - of_core_s
print(f"{len(loaded.keyframes)} keyframes in {took_s:.2f} s, {ready_s:.2f} s until a frame can be,"
      f" {of_core_s:.2f} s of one core;"
      f" {before_mb:.0f} MB before, {loaded_mb:.0f} MB loaded, {most_mb():.0f} MB at most")
"""
SAVE = """
import sys
from pathlib import Path
from placerec import load
from slam import load_map, save_map
recognizer = load(sys.argv[3])
maps = [load_map(Path(each), recognizer) for each in sys.argv[2].split(",")]
print("ready", flush=True)
while True:
    for each in maps:
        save_map(Path(sys.argv[1]), each)
"""


def made_up(count: int, seed: int) -> SavedMap:
    """Return a map of so many keyframes in a row, every tenth of which closes three loops."""
    draw = np.random.default_rng(seed)
    features = Features(
        draw.uniform(0, 480, (FEATURES, 2)).astype(np.float32),
        draw.uniform(0, 480, (FEATURES, 2)).astype(np.float32),
        draw.integers(0, 8, FEATURES, np.uint8),
        draw.integers(0, 256, (FEATURES, 32), np.uint8),
        draw.uniform(0.5, 4, FEATURES).astype(np.float32),
        draw.uniform(0.5, 4, (FEATURES, 3)).astype(np.float32),
    )
    color, depth = (draw.integers(0, 256, size, np.uint8) for size in (18_000, 45_000))
    the_map = LandmarkMap(CAMERA, 8, 64)
    rows = count * LANDMARKS
    first_keyframe = np.repeat(np.arange(count, dtype=np.int32), LANDMARKS)
    the_map.landmarks = Landmarks.of(
        positions_m=draw.normal(size=(rows, 3)),
        descriptors=draw.integers(0, 256, (rows, 32), np.uint8),
        octaves=np.zeros(rows, np.uint8),
        distances_m=np.ones(rows, np.float32),
        directions=np.ones((rows, 3), np.float32),
        observers=np.repeat(first_keyframe[:, None], 8, axis=1),
        sightings=np.ones(rows, np.int32),
        first_keyframe=first_keyframe,
    )
    keyframes = []
    for k in range(count):
        created = np.arange(k * LANDMARKS, (k + 1) * LANDMARKS, dtype=np.int32)
        seen = np.full(FEATURES, -1, np.int32)
        seen[:LANDMARKS] = created
        T_map_cam = np.eye(4)
        T_map_cam[0, 3] = 0.1 * k
        the_map.keyframes.append(MappedKeyframe(features, seen, created, T_map_cam))
        preview: Frame = kept_frame(float(k), (240, 320), CAMERA.depth_scale, color, depth)
        keyframes.append(Keyframe(k, float(k), T_map_cam, features, preview))
    motion = RelativePose(np.eye(4), np.eye(6))
    pairs = [(k - back, k) for k in range(0, count, 10) for back in (30, 40, 50) if k >= back]
    nothing = np.zeros((0, 4), np.float32)
    seen_again = Verification(motion, nothing, np.arange(80) < 50, nothing[:, :3])
    vectors = draw.normal(size=(count, LENGTH)).astype(np.float32)
    return SavedMap(
        camera=CAMERA,
        fingerprint="",
        keyframes=tuple(keyframes),
        sessions=np.zeros(count, np.int64),
        frames=np.full(count, 10),
        embeddings=vectors / np.linalg.norm(vectors, axis=1)[:, None],
        is_new=np.ones(count, bool),
        links=tuple(Link(k - n, k, motion) for k in range(count) for n in (1, 2, 3) if k >= n),
        loops=tuple(Loop(a, b, motion, np.zeros(3), 1.0) for a, b in pairs),
        attempts=tuple(LoopAttempt(b, a, 0.9, seen_again, motion, 1.0, 0.8) for a, b in pairs),
        the_map=the_map,
    )


def killed(folder: Path, maps: list[Path], kills: int, seed: int) -> int:
    """Kill so often while a map is saved, and return how often one of the two was there, whole."""
    draw, whole = random.Random(seed), 0
    recognizer = load(RECOGNIZER)
    for _ in range(kills):
        command = [sys.executable, "-c", SAVE, str(folder)]
        command += [",".join(map(str, maps)), RECOGNIZER]
        process = subprocess.Popen(command, stdout=subprocess.PIPE)
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(draw.uniform(0.0, 1.0))
        process.kill()
        process.wait()
        whole += len(load_map(folder, recognizer).keyframes) in (20, 30)
    return whole


def main() -> int:
    """Measure both; the exit code is 1 where a kill left neither map."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--keyframes", type=int, default=10_000)
    parser.add_argument("--kills", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args()
    from placerec.certificate import fingerprint

    made_by = fingerprint(load(RECOGNIZER))
    with tempfile.TemporaryDirectory() as scratch:
        large, folder = Path(scratch) / "large", Path(scratch) / "map"
        start_s = time.perf_counter()
        save_map(large, replace(made_up(asked.keyframes, asked.seed), fingerprint=made_by))
        size_mb = sum(each.stat().st_size for each in large.rglob("*")) / 1e6
        print(f"saved in {time.perf_counter() - start_s:.0f} s, {size_mb:.0f} MB")
        for _ in range(3):
            subprocess.run([sys.executable, "-c", LOAD, large, RECOGNIZER], check=True)
        shutil.rmtree(large)
        small = [Path(scratch) / f"small{n}" for n in (20, 30)]
        for path, count in zip(small, (20, 30), strict=True):
            save_map(path, replace(made_up(count, asked.seed), fingerprint=made_by))
        shutil.copytree(small[0], folder)
        whole = killed(folder, small, asked.kills, asked.seed)
        print(f"{whole} of {asked.kills} kills left the old map or the new, whole")
    return 0 if whole == asked.kills else 1


if __name__ == "__main__":
    sys.exit(main())
