"""A closure sensor is stuck when it says the same while its forceps go somewhere."""

from __future__ import annotations

import numpy as np
import pytest

from trainer.drivers.closure import STUCK_S, _Watch
from trainer.geometry import Array
from trainer.profile import Jaw

HZ = 100.0


def stuck_s(position: Array) -> float:
    """For how long a count that never changes counts as stuck, at ``position`` (n, 3) mm, 100 a second."""
    jaw = _Watch(Jaw(tool="left", open=100, closed=900))
    for k, at in enumerate(position):
        jaw.moved(500, at, k / HZ)
    return jaw.stuck_s


def test_a_tracker_s_noise_is_no_movement() -> None:
    """0.05 mm of noise in each axis, a minute long: a path of 6 m that leads nowhere."""
    noise = np.random.default_rng(5).normal(0.0, 0.05, (6000, 3))
    assert stuck_s(noise) == 0.0


def test_forceps_that_go_and_return_are_noticed() -> None:
    """They are 10 mm away for half a second; stuck from then on, when the count has been the same for long enough."""
    position: Array = np.zeros((1000, 3))
    position[50:100, 0] = 10.0
    assert stuck_s(position) == pytest.approx(10.0 - STUCK_S, abs=2.0 / HZ)
