# SPDX-License-Identifier: Apache-2.0
"""What adjusting the map did, what loops did, and what each of them did."""

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from slam.evaluation.drift import DriftReport
from slam.output.decision import FALSE, LOOKED_AGAIN, Decision, decisions
from slam.output.ledger.records import InfluenceRecord
from slam.output.ledger.writing import influence_record
from slam.result import SlamResult
from slam.types import Trajectory

# Of the ATE: what a loop alone changes by less is not felt. Loops that agree share their effect.
_FELT = 0.01
_SAID = {"agrees": "agrees with the others", "contradicts": "contradicts the others"}


def counterfactual(result: SlamResult, drift: DriftReport | None) -> dict[str, object]:
    """Return it for summary.json; None stands for unknown.

    - adjusting_moved_mm, loops_moved_mm: root mean square over the frames, from the odometry to the
      adjusted map without loops, and from there to the map with loops.
    - loops: those in use that say something of a map that is not large, the one that moved it most
      first: query_id and match_id, and what the ledger has as `influence`.
    """
    steps = (result.odometry, result.without_loops, result.corrected)
    adjusting_mm, loops_mm = (_moved_mm(*pair) for pair in pairwise(steps))
    is_known = any(each.influence for each in result.attempts)
    loops = by_influence(decisions(result, drift)) if is_known else []
    return {
        "adjusting_moved_mm": adjusting_mm,
        "loops_moved_mm": loops_mm,
        "loops": [
            {"query_id": loop.query.id, "match_id": loop.match.id, **vars(record)}
            for loop, record in loops
        ],
    }


def looked_again(result: SlamResult, drift: DriftReport | None) -> dict[str, object] | None:
    """Return what looking again did, for summary.json; None where loops were not looked for again.

    - rounds: how often.
    - pairs_overlap, pairs_next_similar: how many pairs were tried, by what proposed them.
    - found_overlap, found_next_similar: how many of them are loops in use.
    - found_false: how many of those are false by ground truth; None without.
    - loops_before, dropped: how many were in use before, and how many of those no longer are.
    - moved_mm: root mean square over the frames, by how much the map changed.
    - ate_before_m: of the corrected frames then; now it is ate_corrected_m.
    """
    if (more := result.more_loops) is None:
        return None
    new = [each for each in decisions(result, drift) if each.attempt.proposed_by in LOOKED_AGAIN]
    tried = Counter(each.attempt.proposed_by for each in new)
    found = Counter(each.attempt.proposed_by for each in new if each.attempt.rejection is None)
    can_judge = drift is not None and not drift.unjudged
    before = drift.before_more_loops if drift else None
    return {
        "rounds": more.rounds,
        **{f"pairs_{each}": tried[each] for each in LOOKED_AGAIN},
        **{f"found_{each}": found[each] for each in LOOKED_AGAIN},
        "found_false": sum(each.kind == FALSE for each in new) if can_judge else None,
        "loops_before": more.in_use,
        "dropped": more.dropped,
        "moved_mm": _moved_mm(more.before, result.corrected),
        "ate_before_m": before.ate_rmse_m if before else None,
    }


def looked_again_in_words(result: SlamResult, drift: DriftReport | None) -> str | None:
    """Return what looking again did, half a sentence; None where it was not done."""
    if (told := looked_again(result, drift)) is None:
        return None
    found = [
        f"{told[f'found_{each}']} of {told[f'pairs_{each}']} pairs {words}"
        for each, words in LOOKED_AGAIN.items()
    ]
    rounds = f"{told['rounds']} round{'' if told['rounds'] == 1 else 's'}"
    text = f"{', '.join(found)}, in {rounds}, beside {told['loops_before']} before"
    if told["dropped"]:
        text += f", of which {told['dropped']} are dropped"
    if told["found_false"]:
        text += f"; {told['found_false']} of the new ones are false"
    if told["moved_mm"] is not None:
        text += f"; the path moved {told['moved_mm']:.2g} mm (RMS)"
    if drift and told["ate_before_m"] is not None:
        text += f", ATE {told['ate_before_m']:.4f} m -> {drift.corrected.ate_rmse_m:.4f} m"
    return text


def by_influence(loops: Sequence[Decision]) -> list[tuple[Decision, InfluenceRecord]]:
    """Return the loops of which it is known what they did, the most influential first."""
    known = [(loop, record) for loop in loops if (record := influence_record(loop))]
    return sorted(known, key=lambda each: (-each[1].moved_rms_mm, each[0].query.id))


def left_out(record: InfluenceRecord) -> str:
    """Return what there would be without one loop, for people."""
    told = f"without it the map would lie {record.moved_rms_mm:.2g} mm elsewhere (RMS)"
    if record.helped_mm is None:
        return f"{told}; it {_SAID[record.verdict]}"
    more = "larger" if record.helped_mm >= 0.0 else "smaller"
    return f"{told}, its error {abs(record.helped_mm):.2g} mm {more}"


def in_words(loops: Sequence[Decision], drift: DriftReport | None) -> str | None:
    """Return a sentence on what single loops did, None where that is not known.

    Of those that change the error of the map, the ATE, by next to nothing it says just that.
    """
    found = by_influence(loops)
    if not found:
        return None
    (loop, most), records = found[0], [record for _, record in found]
    if drift is not None and most.helped_mm is not None:
        told = _felt(records, 1000.0 * drift.corrected.ate_rmse_m)
        change = "smaller" if most.helped_mm >= 0.0 else "larger"
        did = f"made the error {abs(most.helped_mm):.2g} mm {change}"
    else:
        odd = sum(record.verdict == "contradicts" for record in records)
        verb = "are" if odd > 1 else "is"
        told = f"{odd or 'none'} of {len(records)} loops {verb} at odds with the others"
        did = _SAID[most.verdict]
    return (
        f"Left out one at a time, {told}; the one that moved the map most, from keyframe"
        f" {loop.query.id} to {loop.match.id}, moved keyframes by {most.moved_rms_mm:.2g} mm (RMS),"
        f" up to {most.moved_most_mm:.2g} mm, and {did}."
    )


def _felt(records: Sequence[InfluenceRecord], ate_mm: float) -> str:
    felt = [each for each in records if abs(each.helped_mm or 0.0) > _FELT * ate_mm]
    kinds = Counter(record.verdict for record in felt)
    verb = "changes" if len(felt) < 2 else "change"
    told = (
        f"{len(felt) or 'none'} of {len(records)} loops {verb} the error by more than {_FELT:.0%}"
    )
    if not felt:
        return told
    return f"{told} ({kinds['helped'] or 'none'} helped, {kinds['hurt'] or 'none'} hurt)"


def _moved_mm(before: Trajectory, after: Trajectory) -> float | None:
    if len(before) == 0 or not np.array_equal(before.timestamps_s, after.timestamps_s):
        return None
    moved_m = (after.T_world_cam - before.T_world_cam)[:, :3, 3]
    return float(1000.0 * np.sqrt((moved_m**2).sum(axis=1).mean()))
