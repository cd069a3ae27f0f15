# SPDX-License-Identifier: Apache-2.0
import signal

import pytest

from placerec.certificate import Certificate


@pytest.fixture(autouse=True, scope="session")
def ctrl_c_interrupts():
    """Let Ctrl-C interrupt the tests also where they run in the background, which ignores it."""
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, usual)


@pytest.fixture
def certificate():
    """Return a made-up certificate, of a recognizer and data that do not exist."""
    return Certificate(
        recognizer="gradients",
        fingerprint="sha256:0",
        data="somewhere",
        images=10,
        skipped=1,
        pairs=45,
        same_place_pairs=9,
        threshold=0.8,
        highest_wrong=0.75,
        recall=0.5,
        threshold_interval=(0.7, 0.85),
        recall_interval=(0.25, 0.75),
        resampled="places",
        resamples=100,
        without_threshold=2,
        seed=0,
        different_places=(-0.1, 0.6),
        same_place=(0.3, 0.9),
        recall_to_verify=0.75,
        curve=((0.9, 1.0, 0.1), (0.8, 1.0, 0.5), (0.2, 0.5, 1.0)),
    )
