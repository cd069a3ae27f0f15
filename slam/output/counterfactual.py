# SPDX-License-Identifier: Apache-2.0
"""What adjusting the map did, what loops did, and what each of them did."""

from collections import Counter
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from slam.evaluation.drift import DriftReport
from slam.output.decision import Decision, decisions
from slam.output.ledger import InfluenceRecord, influence_record
from slam.result import SlamResult
from slam.types import Trajectory

_SAID = {
    "helped": "helped",
    "hurt": "hurt",
    "agrees": "agrees with them",
    "contradicts": "contradicts them",
}


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


def by_influence(loops: Sequence[Decision]) -> list[tuple[Decision, InfluenceRecord]]:
    """Return the loops of which it is known what they did, the most influential first."""
    known = [(loop, record) for loop in loops if (record := influence_record(loop))]
    return sorted(known, key=lambda each: (-each[1].moved_rms_mm, each[0].query.id))


def in_words(loops: Sequence[Decision]) -> str | None:
    """Return a sentence on what single loops did, None where that is not known."""
    found = by_influence(loops)
    if not found:
        return None
    (loop, most), records = found[0], [record for _, record in found]
    kinds = Counter(record.verdict for record in records)
    if most.helped_mm is not None:
        told = f"{kinds['helped']} of {len(records)} loops helped and {kinds['hurt']} hurt"
    else:
        odd = kinds["contradicts"]
        verb = "are" if odd > 1 else "is"
        told = f"{odd or 'none'} of {len(records)} loops {verb} at odds with the others"
    return (
        f"Left out one at a time, {told}; the one that moved the map most, from keyframe"
        f" {loop.query.id} to {loop.match.id}, {_SAID[most.verdict]}: it moved"
        f" keyframes by {most.moved_rms_mm:.2g} mm (RMS), up to {most.moved_most_mm:.2g} mm."
    )


def _moved_mm(before: Trajectory, after: Trajectory) -> float | None:
    if len(before) == 0 or not np.array_equal(before.timestamps_s, after.timestamps_s):
        return None
    moved_m = (after.T_world_cam - before.T_world_cam)[:, :3, 3]
    return float(1000.0 * np.sqrt((moved_m**2).sum(axis=1).mean()))
