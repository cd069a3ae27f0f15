# SPDX-License-Identifier: Apache-2.0
"""The end of a run, whatever ended it: everything that was done is written, and told."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

from placerec.errors import LoopcloseError, cause_of
from slam.config import Config
from slam.datasets.pose_files import PoseFile
from slam.evaluation.drift import DriftReport, compare_drift
from slam.geometry.freed_memory import give_back
from slam.output.claimed_folder import ClaimedFolder
from slam.output.journal import Header, read_journal
from slam.output.map_folder.folder import save_map, saved_map
from slam.output.replay.measurements import Measurements
from slam.output.run_folder import write_outputs
from slam.output.summary import summary_table
from slam.result import SlamResult
from slam.system import Slam
from slam.types import SlamError, Trajectory

_MOST_MEASURED = (
    5000  # keyframes: what was measured of more would fill gigabytes before it is written
)
_HARDLY_ANY, _WORTH_A_WORD = 0.1, 20  # frames placed to each that was not; of these at least
_KILLED = "the run was killed before its end, and finished from what it had kept"


@dataclass(frozen=True)
class Run:
    """What the outputs of a run are made of, its result apart.

    Attributes:
        claimed: the folder that they go to.
        header: what it is of.
        config: the settings that it runs with.
        truth: the true camera poses, None without.
        poses: the poses from elsewhere, None without.
        doubts: asks what is to be said of the recordings; reading them may add something.
        keeps: whether it keeps what it measured, so that it can be decided again.
        save: folder to save the map in for later runs, None for nowhere.
    """

    claimed: ClaimedFolder
    header: Header
    config: Config
    truth: Trajectory | None
    poses: PoseFile | None
    doubts: Callable[[], tuple[str, ...]]
    keeps: bool = True
    save: Path | None = None


@dataclass(frozen=True)
class Ended:
    """What there is to tell of a run.

    Attributes:
        table: the run in a few lines.
        problems: what is missing and why; none after a good run.
        result: what it found out.
    """

    table: str
    problems: tuple[str, ...]
    result: SlamResult


def reason_of(stopped: BaseException) -> str:
    """Return in one line what ended a run early."""
    return "interrupted" if isinstance(stopped, KeyboardInterrupt) else cause_of(stopped)


def conclude(
    run: Run,
    slam: Slam,
    stopped: BaseException | None = None,
    unwritten: Exception | None = None,
    is_whole: bool = True,
) -> Ended:
    """Finish a run, compare it with the truth and write its outputs, as far as each can be done.

    It may have been stopped by something, and its journal may have failed to be written. It is
    whole if it came to the end of its recordings, which one that was killed did not.

    Raises:
        LoopcloseError: nothing was tracked.
    """
    folder = run.claimed.path
    problems: list[str] = []
    give_back()  # to finish takes the most at once
    result = slam.finish()
    give_back()
    drift, doubts = _judge(result, run, problems)
    measured = None
    if run.keeps and not unwritten:
        try:
            measured = _measured(run, slam, is_whole and stopped is None)
        except Exception as error:  # the run is worth more than that it can be decided again
            why = cause_of(error)
            doubts = (*doubts, f"run_slam replay cannot decide about this run again: {why}")
    if unwritten:
        doubts = (f"the work could not be kept on disk on the way: {cause_of(unwritten)}", *doubts)
    if stopped is not None:
        doubts = (f"the run stopped early: {reason_of(stopped)}", *doubts)
        problems.insert(0, f"{reason_of(stopped)}; what was done until then is in {folder}")
    result = replace(result, warnings=(*doubts, *result.missing, *run.doubts(), *result.warnings))
    placed, untracked = len(result.trajectory), len(result.untracked_s)
    if placed < _HARDLY_ANY * untracked and untracked >= _WORTH_A_WORD:
        problems.append(
            f"only {placed} of {placed + untracked} frames could be placed, so that next to nothing"
            f" is known of the rest; {folder / 'report.html'} says why"
        )
    if result.given and not result.given.fits:
        problems.append(f"{result.given.warnings[0]}; what the images alone tell is in {folder}")
    told = (*problems, *result.missing, *(() if is_whole else (_KILLED,)))
    try:
        result = write_outputs(
            run.claimed,
            result,
            drift,
            run.truth,
            run.config,
            run.header.title,
            run.header.command,
            run.poses,
            measured,
            told,
        )
    except LoopcloseError as error:
        problems.append(str(error))
    if run.save is not None:
        try:
            save_map(run.save, saved_map(slam, result))
        except Exception as error:
            problems.append(f"the map is not saved: {cause_of(error)}")
    return Ended(summary_table(result, drift, folder), (*problems, *result.missing), result)


def _measured(run: Run, slam: Slam, is_whole: bool) -> Measurements:
    """Return what a run measured.

    Raises:
        SlamError: it is not all there.
    """
    if (count := len(slam.T_odom_kf)) > _MOST_MEASURED:
        raise SlamError(f"of {count} keyframes, more than {_MOST_MEASURED}, too much was measured")
    journal = read_journal(run.claimed.unfinished)
    keyframes = sum(bool(each and each.new_keyframe) for _, each in journal.frames)
    if keyframes != len(T_odom_kf := slam.T_odom_kf):
        raise SlamError(
            f"of {keyframes} keyframes that were tracked {len(T_odom_kf)} were taken in"
        )
    journal.T_odom_kf.update(T_odom_kf)
    header = replace(journal.header, warnings=run.doubts())
    journal = replace(journal, header=header, is_whole=is_whole)
    return Measurements(journal, slam.remembered, run.truth)


def _judge(
    result: SlamResult, run: Run, problems: list[str]
) -> tuple[DriftReport | None, tuple[str, ...]]:
    """Compare with ground truth where there is enough of it; else say why not."""
    if run.truth is None:
        return None, ()
    try:
        drift = compare_drift(result, run.truth, run.config.evaluation)
    except SlamError as error:
        return None, (f"no ATE can be given: {error}",)
    except Exception as error:  # not the truth's fault
        problems.append(f"the comparison with ground truth is missing: {cause_of(error)}")
        return None, (problems[-1],)
    return drift, drift.doubts
