"""A haptic loop in a thread of its own: reads a tip, renders the force, sleeps until the next period.

The whole loop is one compiled function that does not hold Python's lock, so a scene, a recorder or a garbage
collection beside it do not make it wait. It meets the rest of the program in two small arrays: the tip, which whoever
reads the device writes, and the state, whose first three numbers are the force. A tip that is half written when the
loop reads it is off by one step of its motion at most.

It waits with ``nanosleep`` and reads ``clock_gettime``, which Linux and macOS have. Periods are measured from wake-up
to wake-up and counted by their error in whole microseconds.
"""

from __future__ import annotations

import sys
import threading
import time
from itertools import pairwise
from types import TracebackType
from typing import Any

import numpy as np
from numba import njit, types

from trainer.geometry import Array
from trainer.haptics.rendering import new_state, render
from trainer.mechanics.density_field import DensityField

#: Errors of a period from 0 to this many µs are counted apart, longer ones together.
BINS_US = 50_000

_nanosleep: Any = types.ExternalFunction("nanosleep", types.int32(types.intp, types.intp))
_clock_gettime: Any = types.ExternalFunction("clock_gettime", types.int32(types.int32, types.intp))


class HapticsError(RuntimeError):
    """A loop that cannot run; the text is one line."""


class HapticLoop:
    """Renders a field's force at ``rate_hz`` from ``start()`` to ``stop()``; also a context manager.

    ``tip`` (3,) mm, world: write it from anywhere. ``force`` (3,) mN is what the device is to hold.
    """

    def __init__(self, field: DensityField, rate_hz: float = 1000.0) -> None:
        if sys.platform == "win32":
            raise HapticsError("the haptic loop needs Linux or macOS: it sleeps with nanosleep")
        if not 1.0 <= rate_hz <= 20_000.0:
            raise HapticsError(f"a haptic loop runs at 1 to 20000 Hz, found {rate_hz:g}")
        self.tip: Array = np.full(3, np.nan)
        self.state = new_state()
        self.force: Array = self.state[:3]
        self.rate_hz = rate_hz
        self._counts = np.zeros(BINS_US + 1, dtype=np.int64)
        self._worst = np.zeros(2, dtype=np.int64)
        self._stop = np.zeros(1, dtype=np.int64)
        arguments = (field.density, field.constants, self.tip, self.state, self._counts, self._worst, self._stop)
        # Compiled before the thread begins: a wait of its first period would be counted as an error.
        turn(*arguments, 1, 0, _MONOTONIC)
        self._counts[:], self._worst[:] = 0, 0
        period_ns = round(1e9 / rate_hz)
        self._thread = threading.Thread(
            target=turn, args=(*arguments, period_ns, -1, _MONOTONIC), name="haptics", daemon=True
        )

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        """End the loop after the period that it is in, and set the force to zero."""
        self._stop[0] = 1
        if self._thread.is_alive():
            self._thread.join()
        self.force[:] = 0.0

    def __enter__(self) -> HapticLoop:
        self.start()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.stop()

    def report(self) -> dict[str, Any]:
        """Errors of the periods so far: see :func:`period_report`."""
        return period_report(self.rate_hz, self._counts, int(self._worst[0]))


def period_report(rate_hz: float, counts: np.ndarray, worst_ns: int) -> dict[str, Any]:
    """Percentiles (µs) of the errors that ``counts`` counts by whole microseconds, and their histogram by doublings.

    A percentile is the upper end of its bin, so never too small; the last bin ends at the worst error.
    """
    total = int(counts.sum())
    upto = np.cumsum(counts)
    ends = np.append(np.arange(1, len(counts), dtype=np.float64), worst_ns * 1e-3)

    def percentile(part: float) -> float:
        return float(min(ends[int(np.searchsorted(upto, part * total))], worst_ns * 1e-3)) if total else 0.0

    edges = [0, *(2**k for k in range(16)), len(counts)]
    histogram = [{"from_us": low, "periods": int(counts[low:high].sum())} for low, high in pairwise(edges)]
    return {
        "rate_hz": rate_hz,
        "periods": total,
        "p50_us": percentile(0.5),
        "p99_us": percentile(0.99),
        "p999_us": percentile(0.999),
        "max_us": worst_ns * 1e-3,
        "histogram": histogram,
    }


_MONOTONIC = getattr(time, "CLOCK_MONOTONIC", 1)


@njit(cache=True, nogil=True, error_model="numpy")
def turn(
    density: np.ndarray,
    constants: Array,
    tip: Array,
    state: Array,
    counts: np.ndarray,
    worst: np.ndarray,
    stop: np.ndarray,
    period_ns: int,
    periods: int,
    clock: int,
) -> None:
    """Render and sleep until ``stop[0]`` or for so many ``periods`` (negative: no end); see :class:`HapticLoop`.

    Deadlines are absolute, so lateness does not add up; a loop that is late by more than ten periods goes on from now.
    """
    moment = np.zeros(2, dtype=np.int64)
    wait = np.zeros(2, dtype=np.int64)
    _clock_gettime(clock, moment.ctypes.data)
    now = moment[0] * 1_000_000_000 + moment[1]
    due = now
    woken = now
    done = 0
    while stop[0] == 0 and done != periods:
        render(density, constants, tip, state)
        due += period_ns
        _clock_gettime(clock, moment.ctypes.data)
        now = moment[0] * 1_000_000_000 + moment[1]
        if now > due + 10 * period_ns:
            due = now
        while now < due:
            wait[0] = (due - now) // 1_000_000_000
            wait[1] = (due - now) % 1_000_000_000
            _nanosleep(wait.ctypes.data, 0)
            _clock_gettime(clock, moment.ctypes.data)
            now = moment[0] * 1_000_000_000 + moment[1]
        error = abs(now - woken - period_ns)
        woken = now
        worst[0] = max(worst[0], error)
        counts[min(error // 1000, len(counts) - 1)] += 1
        done += 1
