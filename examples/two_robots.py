# SPDX-License-Identifier: Apache-2.0
"""Two robots that meet: each maps by itself, and learns on the way where it is in a shared map.

    python examples/two_robots.py                        each takes one half of fr1_desk
    python examples/two_robots.py RECORDING              or of another recording
    python examples/two_robots.py RECORDING OTHER        each takes its own

runs both in processes of their own, as fast as was filmed; on two machines, that would be

    python examples/two_robots.py RECORDING --robot robot1 --shared FOLDER
    python examples/two_robots.py RECORDING --robot robot2 --shared FOLDER

They know of each other by a folder that both can reach, and nothing else: `places` in it is a
`PlaceStore`, which tells each where the other saw something alike, and a folder for each robot has
the features of its keyframes, for geometry to say whether that was the same place. The map is the
world of robot1, the name that sorts first. One loop alone, which might be of a twin of the place,
gives neither a place in it: loops at two places have to agree (`align_maps`). From then on each
publishes its poses in the map, and every further loop has a say in where that is.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, TypeVar
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from placerec import PlaceRecognizer, PlaceStore, load
from slam import (
    Camera,
    Config,
    Features,
    Frame,
    Keyframe,
    Loop,
    LoopcloseError,
    Rejection,
    Slam,
    SlamError,
    SlamResult,
    TrackedFrame,
    Trajectory,
    align_maps,
    open_sequence,
    read_tum,
    verify_loop,
    write_tum,
)
from slam.datasets import Sequence, resolve

Array = NDArray[np.float64]
T = TypeVar("T")

NAMES = "robot1", "robot2"
EVERY_S = 1.0  # of its recording a robot tells the other what is new, and asks
CANDIDATES = 3  # places of the other that are verified for each keyframe
PATIENCE_S = 60.0  # that the other may be silent before a robot that is done goes home
POLL_S = 0.2
LEAP_M = 0.1  # by which T_map_odom has moved when it is told again
NO_PREVIEW = Frame(0.0, np.zeros((0, 0, 3), np.uint8), np.zeros((0, 0), np.float32))


def write_whole(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays into a file that others never see in part."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_suffix(".part")
    with part.open("wb") as stream:
        np.savez(stream, **arrays)
    part.replace(path)


def read_arrays(path: Path) -> dict[str, Any]:
    """Return the arrays of such a file.

    Raises:
        SlamError: it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as kept:
            return dict(kept)
    except (OSError, EOFError, ValueError, BadZipFile) as error:
        raise SlamError(f"what a robot wrote cannot be read; begin anew: {path}") from error


def write_keyframe(path: Path, keyframe: Keyframe, camera: Camera) -> None:
    """Write what verifying a loop with a keyframe takes, some 70 kB."""
    told = {"id": keyframe.id, "time_s": keyframe.timestamp_s, "turning": keyframe.turning_rad_s}
    write_whole(
        path, {**vars(keyframe.features), **told, "camera": np.array(json.dumps(asdict(camera)))}
    )


def read_keyframe(path: Path) -> Keyframe:
    """Return the keyframe of a file, without its image, and without a place."""
    arrays = read_arrays(path)
    camera = json.loads(str(arrays.pop("camera")))
    camera = Camera(**{**camera, "distortion": tuple(camera["distortion"])})
    number, time_s, turning = (arrays.pop(each).item() for each in ("id", "time_s", "turning"))
    features = Features(**arrays)
    return Keyframe(number, time_s, np.eye(4), features, NO_PREVIEW, turning, camera=camera)


@dataclass(frozen=True)
class Report:
    """What a robot says of its map, as of now.

    Attributes:
        T_world_kf: (4, 4) by keyframe id, in its own world.
        pairs: keyframes of robot1 and of robot2 that it saw verified as a loop.
        is_finished: whether it has nothing more to say.
    """

    T_world_kf: dict[int, Array]
    pairs: set[tuple[int, int]]
    is_finished: bool

    def write(self, path: Path) -> None:
        """Replace the report before."""
        arrays = {
            "keyframes": np.array(list(self.T_world_kf), np.int64),
            "T_world_kf": np.array(list(self.T_world_kf.values())).reshape(-1, 4, 4),
            "pairs": np.array(sorted(self.pairs), np.int64).reshape(-1, 2),
            "is_finished": np.array(self.is_finished),
        }
        write_whole(path, arrays)

    @staticmethod
    def read(path: Path) -> "Report":
        """Return the report of now."""
        kept = read_arrays(path)
        placed = zip(kept["keyframes"].tolist(), kept["T_world_kf"], strict=True)
        pairs = {(first, second) for first, second in kept["pairs"].tolist()}
        return Report(dict(placed), pairs, bool(kept["is_finished"]))


class Robot:
    """Maps by itself, tells the other what it saw, and finds out how their maps lie.

    Attributes:
        T_map_world: (4, 4), where its world is in the shared map; None while that is not known.
        theirs: what the other said last; None before it came.
        tried: how many pairs of keyframes looked alike.
    """

    def __init__(
        self, name: str, shared: Path, camera: Camera, recognizer: PlaceRecognizer
    ) -> None:
        (self.other,) = set(NAMES) - {name}
        self.name, self._shared, self._camera = name, shared, camera
        self._recognizer = recognizer
        self._store = PlaceStore(shared / "places", recognizer)
        self.slam = Slam(camera, recognizer)
        self.T_map_world: Array | None = None
        self.theirs: Report | None = None
        self.tried = 0
        self._new: list[tuple[Keyframe, NDArray[np.float32]]] = []
        self._segments: dict[int, int] = {}
        self._T_odom_kf: dict[int, Array] = {}
        self._final: dict[int, Array] | None = None  # once the recording is over
        self._told_s = -np.inf
        self._pairs: dict[tuple[int, int], Loop | Rejection] = {}
        self._heard_ns = 0  # when the other's report was written

    def take(self, frame: Frame) -> TrackedFrame | Rejection:
        """Track the next frame; every second tell what is new, and look for the other."""
        tracked = self.slam.process(frame)
        if isinstance(tracked, TrackedFrame) and (keyframe := tracked.new_keyframe):
            # Slam embeds it as well, in a thread of its own: the price of keeping both apart.
            self._new.append((keyframe, self._recognizer.embed(frame.rgb)))
            self._segments[keyframe.id] = keyframe.segment
            self._T_odom_kf |= {**tracked.moved, keyframe.id: keyframe.T_odom_cam}
        if frame.timestamp_s - self._told_s >= EVERY_S:
            self._told_s = frame.timestamp_s
            self.exchange()
        return tracked

    def finish(self) -> SlamResult:
        """Finish the map, and tell the other."""
        result = self.slam.finish()
        poses = enumerate(self.slam.correction.T_world_start @ result.T_world_kf)
        self._final = {k: T for k, T in poses if np.isfinite(T[0, 0])}
        self.exchange()
        return result

    def exchange(self) -> None:
        """Tell the other what is new, ask which of its places look like that, and verify them."""
        new, self._new = self._new, []
        for keyframe, _ in new:
            write_keyframe(self._path(self.name, keyframe.id), keyframe, self._camera)
        if new:  # a place is in the store once its keyframe can be read
            ids, times_s = zip(*((each.id, each.timestamp_s) for each, _ in new), strict=True)
            self._store.add(self.name, ids, times_s, np.stack([each for _, each in new]))
        for keyframe, embedding in new:
            for place in self._store.query(embedding, CANDIDATES, sessions=[self.other]):
                if place.similarity >= self.slam.min_similarity:
                    self._verify(self._in_order(keyframe.id, place.keyframe))
        self.listen()
        pairs = {pair for pair, seen in self._pairs.items() if isinstance(seen, Loop)}
        report = Report(self.T_world_kf(), pairs, self._final is not None)
        report.write(self._shared / self.name / "report.npz")

    def listen(self) -> None:
        """Read what the other says now, and work out how the maps lie."""
        path = self._shared / self.other / "report.npz"
        if path.exists() and (written_ns := path.stat().st_mtime_ns) != self._heard_ns:
            self._heard_ns, self.theirs = written_ns, Report.read(path)
            for pair in self.theirs.pairs:
                self._verify(pair)
        if self.theirs is None:
            return
        T_first_second = align_maps(
            *self._in_order(self.T_world_kf(), self.theirs.T_world_kf), self.loops
        )
        if not isinstance(T_first_second, Rejection):
            self.T_map_world = np.eye(4) if self.is_first else T_first_second

    def wait(self, patience_s: float = PATIENCE_S) -> bool:
        """Listen until the other has finished, which is returned, or was silent for too long."""
        heard_s = time.monotonic()
        while True:
            before = self.theirs
            self.listen()
            if self.theirs and self.theirs.is_finished:
                return True
            if self.theirs is not before:
                heard_s = time.monotonic()
            elif time.monotonic() - heard_s > patience_s:
                return False
            time.sleep(POLL_S)

    @property
    def is_first(self) -> bool:
        """Whether its world is the map."""
        return self.name < self.other

    @property
    def loops(self) -> list[Loop]:
        """The verified loops between the two, from keyframes of robot1 to those of robot2."""
        return [each for each in self._pairs.values() if isinstance(each, Loop)]

    def T_map_odom(self) -> Array | None:
        """Return (4, 4) where the odometry's frame is in the shared map, None while not known."""
        if self.T_map_world is None:
            return None
        try:
            return np.asarray(self.T_map_world @ self.slam.T_world_odom())
        except SlamError:  # it lost its way
            return None

    def T_world_kf(self) -> dict[int, Array]:
        """Return (4, 4) by id where keyframes are in its own world, as far as that is known."""
        if self._final is not None:
            return self._final
        now = self.slam.correction
        tracked = {
            k: now.T_world_odom[self._segments[k]] @ T
            for k, T in self._T_odom_kf.items()
            if self._segments[k] in now.T_world_odom
        }
        return {**tracked, **now.T_world_kf}

    def _path(self, name: str, keyframe: int) -> Path:
        return self._shared / name / "keyframes" / f"{keyframe:06d}.npz"

    def _in_order(self, mine: T, theirs: T) -> tuple[T, T]:
        """Return what is of robot1, and what of robot2."""
        return (mine, theirs) if self.is_first else (theirs, mine)

    def _verify(self, pair: tuple[int, int]) -> None:
        """Both verify keyframes in one order, and so both come to the same loop."""
        if pair not in self._pairs:
            self.tried += 1
            files = [self._path(name, k) for name, k in zip(NAMES, pair, strict=True)]
            match, query = map(read_keyframe, files)
            self._pairs[pair] = verify_loop(match, query, self._camera)


def film(sequence: Sequence, part: tuple[float, float]) -> Iterable[Frame]:
    """Yield the frames of a part of a recording, shares of it, no faster than they were filmed."""
    ends = [round(share * len(sequence.timestamps_s)) for share in part]
    times_s = sequence.timestamps_s[slice(*ends)]
    if not len(times_s):
        raise SlamError(f"the recording has too few frames for two robots: {sequence.name}")
    start_s = time.monotonic() - times_s[0]
    for i, time_s in enumerate(times_s, ends[0]):
        time.sleep(max(0.0, start_s + time_s - time.monotonic()))
        yield sequence.frame(i)


def drive(
    robot: Robot, frames: Iterable[Frame], shared: Path, patience_s: float = PATIENCE_S
) -> bool:
    """Run a robot to its end, and say what happens; return whether it has a place in the map."""
    published: list[tuple[float, Array]] = []
    start_s: float | None = None
    told: Array | None = None
    for frame in frames:
        start_s = frame.timestamp_s if start_s is None else start_s
        tracked, T_map_odom = robot.take(frame), robot.T_map_odom()
        if T_map_odom is not None and isinstance(tracked, TrackedFrame):
            if told is None or np.linalg.norm((T_map_odom - told)[:3, 3]) > LEAP_M:
                told = T_map_odom
                tell_meeting(robot, f"{frame.timestamp_s - start_s:.1f} s", T_map_odom)
            published.append((frame.timestamp_s, T_map_odom @ tracked.T_odom_cam))
    result = robot.finish()
    is_complete = robot.wait(patience_s)
    if robot.theirs is None:
        say(robot, f"{robot.other} never came: nothing of it is in {shared}")
    elif not is_complete:
        say(robot, f"{robot.other} was silent for {patience_s:g} s; what it said until then stays")
    if robot.T_map_world is None:
        say(
            robot,
            f"no T_map_odom: {robot.tried} pairs of views looked alike, {len(robot.loops)} of them"
            " were verified as loops; loops have to agree at two places",
        )
        return False
    if told is None:
        tell_meeting(robot, "the end", robot.T_map_world)
    final = result.trajectory
    T_map_cam = robot.T_map_world @ robot.slam.correction.T_world_start @ final.T_world_cam
    if published:
        times_s, T_live = zip(*published, strict=True)
        write_tum(shared / robot.name / "live.txt", Trajectory(np.array(times_s), np.array(T_live)))
    write_tum(shared / robot.name / "trajectory.txt", Trajectory(final.timestamps_s, T_map_cam))
    say(robot, f"{len(published)} poses published in the map, {len(robot.loops)} loops in the end")
    return True


def tell_meeting(robot: Robot, when: str, T_map_odom: Array) -> None:
    """Say where the odometry's frame turned out to be."""
    x, y, z = T_map_odom[:3, 3]
    turned_deg = np.degrees(Rotation.from_matrix(T_map_odom[:3, :3]).magnitude())
    at = f"{x:.3f} {y:.3f} {z:.3f} m, turned by {turned_deg:.1f} degrees"
    say(robot, f"after {when}: T_map_odom is {at}, by {len(robot.loops)} loops")


def say(robot: Robot, what: str) -> None:
    """Say something at once."""
    print(f"{robot.name}  {what}", flush=True)


def ate_mm(paths: list[Trajectory], truths: list[Trajectory]) -> float:
    """Return the RMSE of positions, millimetres, all paths laid on the truth by one motion."""
    ours, theirs = [], []
    for path, truth in zip(paths, truths, strict=True):
        after = np.searchsorted(truth.timestamps_s, path.timestamps_s).clip(1, len(truth) - 1)
        near = np.stack([after - 1, after])
        apart_s = np.abs(truth.timestamps_s[near] - path.timestamps_s)
        nearest = near[np.argmin(apart_s, axis=0), np.arange(len(after))]
        is_known = apart_s.min(axis=0) < 0.02
        ours.append(path.T_world_cam[is_known, :3, 3])
        theirs.append(truth.T_world_cam[nearest[is_known], :3, 3])
    centred = [np.concatenate(each) - np.concatenate(each).mean(axis=0) for each in (theirs, ours)]
    _, rssd = Rotation.align_vectors(*centred)
    return float(1000.0 * rssd / np.sqrt(len(centred[0])))


def tell_errors(shared: Path, truths: list[Trajectory]) -> None:
    """Say how far both robots are from the truth in one frame, and each by itself."""
    for what, file in (("published", "live.txt"), ("in the end", "trajectory.txt")):
        files = [shared / name / file for name in NAMES]
        if not all(each.exists() for each in files):  # they met when their recordings were over
            continue
        paths = [read_tum(each) for each in files]
        alone = [ate_mm([path], [truth]) for path, truth in zip(paths, truths, strict=True)]
        told = ", ".join(f"{name} alone {e:.1f}" for name, e in zip(NAMES, alone, strict=True))
        print(f"ATE of the poses {what}: {ate_mm(paths, truths):.1f} mm in one frame; {told}")


def run_one(name: str, recordings: list[Sequence], shared: Path) -> bool:
    """Run one robot in this process; return whether it has a place in the map."""
    number = NAMES.index(name)
    part = (0.0, 1.0) if len(recordings) == 2 else (number / 2, (number + 1) / 2)
    robot = Robot(name, shared, recordings[-1 if number else 0].camera, load("learned"))
    return drive(robot, film(recordings[-1 if number else 0], part), shared)


def main(arguments: list[str] | None = None) -> int:
    """Run one robot or both; return 0 if all have a place in the map, 1 if not."""
    parser = argparse.ArgumentParser(description="Two robots that meet.")
    parser.add_argument("recordings", nargs="*", help="one or two, named as for run_slam")
    parser.add_argument("--shared", type=Path, default=Path("runs/two_robots"), metavar="FOLDER")
    parser.add_argument("--robot", choices=NAMES, help="run this one alone")
    told = parser.parse_args(arguments)
    names = told.recordings or ["fr1_desk"]
    if len(names) > 2:
        parser.error("two robots take two recordings at most")
    for name in [told.robot] if told.robot else NAMES:
        if (told.shared / name).exists():
            raise SlamError(f"{name} was here before; choose another folder: {told.shared}")
    recordings = [open_sequence(resolve(name), Config().input) for name in names]
    if told.robot:
        return 0 if run_one(told.robot, recordings, told.shared) else 1
    PlaceStore(told.shared / "places", load("learned"))  # says early what is missing
    command = [sys.executable, __file__, *names, "--shared", str(told.shared)]
    robots = [subprocess.Popen([*command, "--robot", name]) for name in NAMES]
    codes = [abs(each.wait()) for each in robots]
    truths = [each.ground_truth for each in (recordings[0], recordings[-1])]
    known = [each for each in truths if each is not None]
    if not any(codes) and len(known) == 2:
        tell_errors(told.shared, known)
    return max(codes)


if __name__ == "__main__":
    try:
        sys.exit(main())
    except LoopcloseError as error:
        print(error, file=sys.stderr)
        sys.exit(2)
    except KeyboardInterrupt:
        sys.exit(130)
