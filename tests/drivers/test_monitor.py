"""Rate, jitter and loss are those of the stream, counted by the device or judged by its period."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.drivers.monitor import Arrival, Seen, arrival, seen


def test_a_steady_stream_has_its_rate_and_neither_jitter_nor_loss() -> None:
    """1000 records at 100 Hz. Times below 10 s are rounded by 9e-16 s; a microsecond is far above."""
    found = arrival(np.arange(1000) / 100, np.arange(1000))
    assert found.rate_hz == pytest.approx(100.0, rel=1e-12)
    assert found.interval_median_ms == pytest.approx(10.0, rel=1e-9)
    assert found.jitter_ms == pytest.approx(0.0, abs=1e-9)
    assert (found.records, found.lost, found.loss_percent) == (1000, 0, 0.0)


@given(keep=st.sets(st.integers(1, 198)), late=st.floats(0.0, 0.4))
def test_what_is_lost_is_counted_either_way_and_is_no_jitter(keep: set[int], late: float) -> None:
    """200 records sent at 100 Hz, each second one late by up to two fifths of a period, some lost.

    The device's own count and what is missing of the rate, off by less than half a period, must agree.
    """
    sent = np.arange(200)
    time = (sent + late * (sent % 2)) / 100
    arrived = np.array(sorted({0, 199} | keep))
    counted = arrival(time[arrived], arrived)
    judged = arrival(time[arrived], nominal_hz=100.0)
    assert counted.lost == judged.lost == 200 - len(arrived)
    assert counted.loss_percent == pytest.approx(100 * (200 - len(arrived)) / 200)
    if counted.jitter_ms is not None:
        assert counted.jitter_ms <= 10 * late + 1e-9  # intervals of 1 ± late periods


def test_jitter_is_the_standard_deviation_of_the_intervals() -> None:
    """Intervals of 8 and 12 ms by turns: 2 ms."""
    time = np.cumsum(np.tile([0.008, 0.012], 50))
    assert arrival(time, nominal_hz=100.0).jitter_ms == pytest.approx(2.0, rel=0.02)
    assert arrival(time).interval_max_ms == pytest.approx(12.0)
    assert (arrival(time).lost, arrival(time).loss_percent) == (None, None)


def test_silence_at_the_ends_is_lost_and_slows_the_rate() -> None:
    """100 records at 100 Hz, listened to from 1 s before the first to 8 s after the last: 900 of 1000 lost, to one."""
    found = arrival(5.0 + np.arange(100) / 100, nominal_hz=100.0, span=(4.0, 13.99))
    assert found.lost == pytest.approx(900, abs=1)
    assert found.loss_percent == pytest.approx(90.0, abs=0.1)
    assert found.rate_hz == pytest.approx(10.0, abs=0.1)
    nothing = arrival(np.zeros(0), nominal_hz=100.0, span=(4.0, 5.0))
    assert (nothing.lost, nothing.loss_percent) == (pytest.approx(100, abs=1), 100.0)
    assert seen(np.zeros((100, 3)), np.ones(100, dtype=bool), None, lost=900).seen_percent == 10.0


@pytest.mark.parametrize("n", [0, 1])
def test_one_record_says_nothing_of_a_rate(n: int) -> None:
    assert arrival(np.ones(n), np.arange(n)) == Arrival(n, 0.0, None, None, None, None, None, None, None)


def test_records_of_one_burst_have_no_rate() -> None:
    assert arrival(np.ones(5), np.arange(5)).rate_hz is None


def test_a_sensor_was_last_where_it_was_last_seen() -> None:
    position = np.arange(12.0).reshape(4, 3)
    ok = np.array([True, True, True, False])
    assert seen(position, ok, np.array([0.1, 0.2, 0.3, 0.4])) == Seen(75.0, (6.0, 7.0, 8.0), 0.4)
    assert seen(position, np.zeros(4, dtype=bool), None) == Seen(0.0, None, None)
    assert seen(position[:0], ok[:0], np.zeros(0)) == Seen(0.0, None, None)
