"""The pace of a session: a fixed tick in real time, or as fast as the machine goes.

A clock never tells the simulation what time it is: simulated time is the tick's number divided by the
rate. A clock only waits for a tick's slot to begin and measures how long the tick's work took.
"""

from __future__ import annotations

import math
import time
from array import array
from collections.abc import Sequence

#: Behind by more than this, a session in real time goes on from where it is and skips the time between: running the
#: missed ticks in a burst would move the scene under the trainee's hands. Assumed. A machine that was suspended skips
#: nothing on Linux, where this clock stands still meanwhile.
LARGEST_LAG_S = 0.25


class Fast:
    """Ticks follow each other at once.

    Between ``begin()`` and ``end()`` lies the work of one tick; ``end`` returns its length in ms.
    """

    realtime = False

    def __init__(self, tick_hz: float) -> None:
        self.tick_hz = tick_hz
        self.slot_ms = 1e3 / tick_hz
        self._begun_ns = 0
        self.work_ms = array("d")  # of every tick so far
        self.skipped_s = 0.0  # time on the wall that no tick stands for

    def begin(self) -> float:
        """Wait for the slot of the next tick. Returns how much time, s, was skipped before it."""
        self._begun_ns = time.perf_counter_ns()
        return 0.0

    def end(self) -> float:
        work_ms = (time.perf_counter_ns() - self._begun_ns) * 1e-6
        self.work_ms.append(work_ms)
        return work_ms

    def report(self) -> dict[str, float]:
        """Work per tick, see :func:`pace`, and the time that was skipped."""
        return {**pace(self.tick_hz, self.work_ms), "skipped_s": self.skipped_s}


class Realtime(Fast):
    """Tick k begins k / ``tick_hz`` seconds after tick 0; deadlines are absolute, so lateness does not add up.

    It sleeps until the deadline and does not spin: the operating system wakes it 0.15 ms late (median, measured
    on Linux with all cores busy), which no trainee notices, and a spinning core is taken from the sinks' threads.
    """

    realtime = True

    def __init__(self, tick_hz: float) -> None:
        super().__init__(tick_hz)
        self._due_s = 0.0

    def begin(self) -> float:
        now = time.perf_counter()
        skipped_s = 0.0
        if not self.work_ms:
            self._due_s = now
        elif now - self._due_s > LARGEST_LAG_S:
            skipped_s = now - self._due_s
            self._due_s = now
        elif now < self._due_s:
            time.sleep(self._due_s - now)
        self._due_s += 1.0 / self.tick_hz
        self.skipped_s += skipped_s
        super().begin()
        return skipped_s


def pace(tick_hz: float, work_ms: Sequence[float]) -> dict[str, float]:
    """Work per tick: ``overruns`` is the number of ticks that took longer than their slot of 1 / ``tick_hz``."""
    ordered = sorted(work_ms)
    return {
        "tick_hz": tick_hz,
        "overruns": sum(ms > 1e3 / tick_hz for ms in ordered),
        "p50_ms": _percentile(ordered, 0.50),
        "p99_ms": _percentile(ordered, 0.99),
        "max_ms": ordered[-1] if ordered else 0.0,
    }


def _percentile(ordered: list[float], fraction: float) -> float:
    """The smallest value that at least ``fraction`` of the sorted values do not exceed (nearest rank); 0 of none."""
    if not ordered:
        return 0.0
    return ordered[math.ceil(fraction * len(ordered)) - 1]
