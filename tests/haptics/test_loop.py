"""The haptic loop: it renders while it runs, counts its periods, and stops."""

from __future__ import annotations

import os
import sys
import threading
import time

import numpy as np
import pytest
from waiting import PATIENCE_S, wait_for

from trainer.geometry import Rigid
from trainer.haptics.loop import BINS_US, HapticLoop, HapticsError, period_report
from trainer.mechanics.density_field import DensityField, density_field

compiled = pytest.mark.skipif(
    os.environ.get("NUMBA_DISABLE_JIT", "0") == "1", reason="the loop calls the C library, which only compiled code can"
)


def wall() -> DensityField:
    rigid = np.zeros((8, 8, 16), dtype=bool)
    rigid[:, :, :8] = True
    return density_field(rigid, (1.0, 1.0, 1.0), Rigid.identity(), 500.0, 3000.0)


@compiled
def test_it_renders_counts_and_stops() -> None:
    with HapticLoop(wall(), 1000.0) as loop:
        loop.tip[:] = 4.0, 4.0, 7.0
        assert wait_for(lambda: bool(loop.force[2] > 0.0))
        assert wait_for(lambda: loop.report()["periods"] >= 20)
        assert "haptics" in {thread.name for thread in threading.enumerate()}
    report = loop.report()
    assert loop.force.tolist() == [0.0, 0.0, 0.0]
    assert "haptics" not in {thread.name for thread in threading.enumerate()}
    assert sum(row["periods"] for row in report["histogram"]) == report["periods"] >= 20
    assert report["p50_us"] <= report["p99_us"] <= report["p999_us"] <= report["max_us"]
    assert report["max_us"] > 0.0  # no twenty periods are right to the nanosecond


@compiled
def test_it_runs_while_python_is_busy() -> None:
    """A thread that never lets go of Python's lock of its own accord does not stop the loop: it gets on meanwhile.

    With the switch interval raised to twice the time that is waited, the loop could not run one period if it needed the
    lock. numpy's own sums let go of it.
    """
    old = sys.getswitchinterval()
    with HapticLoop(wall(), 2000.0) as loop:
        assert wait_for(lambda: loop.report()["periods"] > 0)
        sys.setswitchinterval(2.0 * PATIENCE_S)
        try:
            before = sum(loop._counts.tolist())
            end = time.monotonic() + PATIENCE_S
            while time.monotonic() < end and sum(loop._counts.tolist()) < before + 10:
                pass
            after = sum(loop._counts.tolist())
        finally:
            sys.setswitchinterval(old)
    assert after >= before + 10


@compiled
def test_an_impossible_rate_is_refused() -> None:
    with pytest.raises(HapticsError, match="1 to 20000 Hz"):
        HapticLoop(wall(), 0.0)


def test_percentiles_come_from_the_counts() -> None:
    """990 errors in bin 4, 9 in bin 99, one of 70 ms: half below 5 µs, 99 % too, 99.9 % below 100, worst as it was."""
    counts = np.zeros(BINS_US + 1, dtype=np.int64)
    counts[4], counts[99], counts[-1] = 990, 9, 1
    report = period_report(1000.0, counts, 70_000_000)
    assert (report["p50_us"], report["p99_us"], report["p999_us"], report["max_us"]) == (5.0, 5.0, 100.0, 70_000.0)
    assert [row["periods"] for row in report["histogram"] if row["periods"]] == [990, 9, 1]
