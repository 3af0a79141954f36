"""The line through a device's samples: exact without jitter, closer than the jitter with it, whole after losses."""

from __future__ import annotations

import numpy as np
import pytest

from trainer.drivers.clock_line import BREAK, ClockLine


def test_even_samples_lie_on_their_line() -> None:
    """Time t0 + k T with T 3 % off what was asked for: from the tenth sample on the line is exact.

    Sums relative to the newest sample hold numbers below 206² T = 420 s; rounding 1e-13 of that in each of a dozen
    operations, divided by sums of the same kind, stays below 1e-9 s.
    """
    line = ClockLine(1 / 103)
    period = 1 / 100
    due = [line.observe(5000.0 + k * period) for k in range(1000)]
    np.testing.assert_allclose(due[9:], 5000.0 + period * np.arange(9, 1000), rtol=0, atol=1e-9)
    assert line.period_s == pytest.approx(period, abs=1e-9)


def test_lost_samples_do_not_bend_the_line() -> None:
    rng = np.random.default_rng(2)
    line = ClockLine(1 / 103)
    index = np.cumsum(rng.choice([1, 1, 1, 1, 2, 5], 500))
    due = [line.observe(10.0 + k / 103) for k in index.tolist()]
    np.testing.assert_allclose(due, 10.0 + index / 103, rtol=0, atol=1e-9)


def test_the_jitter_of_an_adapter_is_taken_away() -> None:
    """Delays even in 0 to 4 ms, sd 1.15 ms. A fit whose weights fade over N = 206 has the variance of about 4/(2N) of
    it at its newest end (constant and slope together), sd 0.12 ms; five of that, beside the mean delay of 2 ms."""
    rng = np.random.default_rng(4)
    line = ClockLine(1 / 103)
    true = 100.0 + np.arange(3000) / 103
    due = np.array([line.observe(t) for t in true + rng.uniform(0, 0.004, 3000)])
    error = (due - true - 0.002)[1000:]
    assert np.abs(error).max() < 0.0006
    assert line.jitter_s == pytest.approx(0.004 / np.sqrt(12), rel=0.1)


def test_a_pause_begins_a_new_line() -> None:
    line = ClockLine(0.01)
    for k in range(100):
        line.observe(0.0102 * k)
    later = 1.0098 + (BREAK + 2) * 0.0102
    assert line.observe(later) == later
    assert line.period_s == 0.01
