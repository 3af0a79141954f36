"""The line through a device's samples: exact without jitter, closer than the jitter with it, whole after losses."""

from __future__ import annotations

import numpy as np
import pytest

from trainer.drivers.clock_line import BREAK, ENOUGH, ClockLine


def test_even_samples_lie_on_their_line() -> None:
    """Time t0 + k T with T 3 % off what was asked for: when there are enough samples the line is exact.

    Sums relative to the newest sample hold numbers below 206² T = 420 s; rounding 1e-13 of that in each of a dozen
    operations, divided by sums of the same kind, stays below 1e-9 s.
    """
    line = ClockLine(1 / 103)
    period = 1 / 100
    due = [line.observe(5000.0 + k * period) for k in range(1000)]
    np.testing.assert_allclose(due[ENOUGH - 1 :], 5000.0 + period * np.arange(ENOUGH - 1, 1000), rtol=0, atol=1e-9)
    assert line.period_s == pytest.approx(period, abs=1e-9)
    now_s = 5000.0 + 999.5 * period
    assert line.read(now_s) == (pytest.approx(999.5, abs=1e-6), 1)


def test_samples_that_come_together_at_the_start_are_none_lost() -> None:
    """Thirty that a busy machine hands over at once, then each in its time, at the period that was asked for: the line
    begins up to 30 periods late, and its count is the samples' own, plus or minus the fraction that has gone by."""
    line = ClockLine(0.01)
    for _ in range(30):
        line.observe(10.3)
    for k in range(30, 2000):
        line.observe(10.0 + 0.01 * (k + 1))
    assert line.read(10.0 + 0.01 * 2000)[0] == pytest.approx(1999, abs=1.0)


def test_lost_samples_are_counted_when_none_catches_up() -> None:
    """Of every 200 samples 1 to 5 are lost, when the line has settled.

    For 7 samples the index is m <= 5 too low; with fading weights (N = 206)
    that bends the slope by at most 7 m / (2 N²) = 4e-4 of a period for each loss, of which two or three are remembered,
    and moves the newest end by at most 7 m · 4 / (2 N) = 0.34 periods for each: together less than 1 % and a period."""
    rng = np.random.default_rng(2)
    line = ClockLine(1 / 103)
    steps = np.ones(4000, dtype=int)
    steps[800::200] += rng.integers(1, 6, len(steps[800::200]))
    index = np.cumsum(steps)
    due = np.array([line.observe(10.0 + k / 103) for k in index.tolist()])
    known = np.arange(4000) % 200 > 20  # when the last loss has been counted
    assert np.abs(due - 10.0 - index / 103)[known].max() < 1 / 103
    assert line.period_s == pytest.approx(1 / 103, rel=0.01)


def test_an_adapter_that_hands_over_every_16_ms_does_not_change_the_rate() -> None:
    """The delay is even in 0 to 16 ms, sd 0.48 periods: the slope of a fit with fading weights has an sd of about
    0.48 / N^1.5 = 1.6e-4 periods; 0.5 % is thirty of it."""
    line = ClockLine(1 / 103)
    for t in np.arange(3000) / 103:
        line.observe(float(np.ceil(t / 0.016) * 0.016))
    assert line.period_s == pytest.approx(1 / 103, rel=0.005)


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


@pytest.mark.parametrize("hz", [51.5, 80.0, 103.0, 140.0])
def test_the_rate_is_that_of_the_samples_whatever_was_asked_for(hz: float) -> None:
    """Even samples have no jitter, to the rounding above, and none is told of a line that is not theirs."""
    line = ClockLine(1 / 103)
    for k in range(2000):
        line.observe(k / hz)
    line.observe(2000 / hz + 5.0)  # a pause is none of its intervals
    assert line.rate_hz == pytest.approx(hz, rel=1e-9)
    assert line.jitter_s == (pytest.approx(0.0, abs=1e-9) if hz == 103.0 else None)
