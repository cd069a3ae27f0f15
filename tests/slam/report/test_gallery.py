# SPDX-License-Identifier: Apache-2.0
import base64
from dataclasses import replace
from io import BytesIO

import numpy as np
import pytest
from PIL import Image

from slam.report.decision import ACCEPTED, FALSE, OUTVOTED, decisions
from slam.report.gallery import INLIER, choose, picture, spread
from slam.types import Verification


def decode(uri: str) -> np.ndarray:
    kind, data = uri.split(",")
    assert kind == "data:image/jpeg;base64"
    return np.asarray(Image.open(BytesIO(base64.b64decode(data)))).astype(int)


def test_matches_are_drawn_where_they_were_seen(run) -> None:
    loop = next(one for one in decisions(run.result, run.drift) if one.attempt.verification)
    dark = replace(loop.query.preview, rgb=np.zeros((240, 320, 3), np.uint8))
    pixels = np.array([[160.0, 120.0, 480.0, 120.0]])  # at a quarter of the height
    seen = Verification(loop.attempt.outcome, pixels, np.array([True]))
    loop = replace(
        loop,
        attempt=replace(loop.attempt, verification=seen),
        query=replace(loop.query, preview=dark),
        match=replace(loop.match, preview=dark),
    )
    image = decode(picture(loop, run.result.camera))
    assert image.shape == (180, 480, 3)
    rows, columns = np.nonzero(image[:, :, 1] > INLIER[1] / 3)
    assert abs(rows.mean() - 45) < 2
    assert abs(columns.min() - 60) < 5
    assert abs(columns.max() - (240 + 180)) < 5


def test_a_pair_without_verification_is_shown_plain(run) -> None:
    loop = next(one for one in decisions(run.result, None) if one.attempt.verification is None)
    assert decode(picture(loop, run.result.camera)).shape == (180, 480, 3)


@pytest.mark.parametrize("limit", [0, 1, 10, 30, 1000])
def test_the_choice_keeps_to_its_limit_and_repeats_nothing(run, limit: int) -> None:
    loops = decisions(run.result, run.drift)
    chosen = choose(loops, limit)
    assert len(chosen) <= limit
    assert len({id(loop) for loop in chosen}) == len(chosen)
    if limit >= 30:
        doubtful = [loop for loop in loops if loop.kind in (FALSE, OUTVOTED)]
        assert chosen[: len(doubtful)] == sorted(doubtful, key=lambda one: one.kind != FALSE)


def test_accepted_loops_are_spread_over_time(run) -> None:
    accepted = [loop for loop in decisions(run.result, run.drift) if loop.kind == ACCEPTED]
    shown = spread(accepted, 4)
    assert len(shown) == 4
    assert shown[0] in accepted[: len(accepted) // 4 + 1]
    assert shown[-1] in accepted[-len(accepted) // 4 - 1 :]


def test_near_misses_come_before_clear_cases(run) -> None:
    shown = choose(decisions(run.result, run.drift), 40)
    gaps = [loop.shortfall for loop in shown if loop.attempt.verification and loop.shortfall]
    hopeless = max(loop.shortfall for loop in decisions(run.result, run.drift))
    assert gaps
    assert min(gaps) < 0.5 * hopeless
