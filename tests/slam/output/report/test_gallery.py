# SPDX-License-Identifier: Apache-2.0
import base64
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from slam.output.decision import ACCEPTED, FALSE, OUTVOTED, Decision, decisions
from slam.output.report.gallery import choose, picture
from slam.types import Rejection, RejectionReason, Verification


def decode(uri: str) -> np.ndarray:
    kind, data = uri.split(",")
    assert kind == "data:image/jpeg;base64"
    return np.asarray(Image.open(BytesIO(base64.b64decode(data)))).astype(int)


def test_matches_are_drawn_where_they_were_seen(run) -> None:
    loop = next(one for one in decisions(run.result, run.drift) if one.attempt.verification)
    dark = replace(loop.query.preview, rgb=np.zeros((240, 320, 3), np.uint8))
    pixels = np.array([[160.0, 120.0, 480.0, 120.0]])  # at a quarter of the height
    seen = Verification(loop.attempt.outcome, pixels, np.array([True]), np.zeros((1, 3)))
    loop = replace(
        loop,
        attempt=replace(loop.attempt, verification=seen),
        query=replace(loop.query, preview=dark),
        match=replace(loop.match, preview=dark),
    )
    image = decode(picture(loop, run.result.camera))
    assert image.shape == (180, 480, 3)
    rows, columns = np.nonzero(image[:, :, 1] > 75)  # inliers are green
    assert abs(rows.mean() - 45) < 2
    assert abs(columns.min() - 60) < 5
    assert abs(columns.max() - (240 + 180)) < 5


def test_a_pair_without_verification_is_shown_plain(run) -> None:
    loop = next(one for one in decisions(run.result, None) if one.attempt.verification is None)
    assert decode(picture(loop, run.result.camera)).shape == (180, 480, 3)


def test_a_loop_of_a_large_map_is_shown_plain_and_its_matches_are_counted(run) -> None:
    loop = next(one for one in decisions(run.result, None) if one.inliers)
    bare = loop.attempt.verification.without_evidence
    later = replace(loop, attempt=replace(loop.attempt, verification=bare))
    assert later.matches == loop.matches and later.inliers == loop.inliers
    unseen = replace(loop, attempt=replace(loop.attempt, verification=None))
    camera = run.result.camera
    assert picture(later, camera) == picture(unseen, camera) != picture(loop, camera)


@pytest.mark.parametrize("limit", [0, 1, 10, 30, 1000])
def test_the_choice_keeps_to_its_limit_and_repeats_nothing(run, limit: int) -> None:
    loops = decisions(run.result, run.drift)
    chosen = choose(loops, limit)
    assert len(chosen) <= limit
    assert len({id(loop) for loop in chosen}) == len(chosen)


def test_doubtful_loops_come_first(run) -> None:
    first = next(i for i, one in enumerate(run.drift.loops) if one.is_false is False)
    truths = list(run.drift.loops)
    truths[first] = replace(truths[first], is_false=True)
    loops = decisions(run.result, replace(run.drift, loops=tuple(truths)))
    kinds = [loop.kind for loop in choose(loops, 20)]
    outvoted = sum(loop.kind == OUTVOTED for loop in loops)
    assert outvoted > 0
    assert kinds[: 1 + outvoted] == [FALSE] + outvoted * [OUTVOTED]


def test_accepted_loops_are_spread_over_time(run) -> None:
    accepted = [loop for loop in decisions(run.result, run.drift) if loop.kind == ACCEPTED]
    shown = choose(accepted, 4)
    assert len(shown) == 4
    assert shown[0] in accepted[: len(accepted) // 4 + 1]
    assert shown[-1] in accepted[-len(accepted) // 4 - 1 :]


def test_of_every_reason_the_closest_miss_comes_first(run) -> None:
    few = [loop for loop in decisions(run.result, None) if loop.kind == "few_inliers"][:3]
    other = [loop for loop in decisions(run.result, None) if loop.kind == "low_similarity"][:2]
    missed = [miss(loop, had) for loop, had in zip(few, (3, 24, 10), strict=True)]
    order = choose([*missed, *other])
    assert {id(one) for one in order[:2]} == {id(missed[1]), id(other[0])}
    assert order[-1] is missed[0]


def miss(loop: Decision, had: float) -> Decision:
    refusal = Rejection(RejectionReason.FEW_INLIERS, had, 25)
    return replace(loop, attempt=replace(loop.attempt, outcome=refusal))
