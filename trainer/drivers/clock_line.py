"""When a device's clock ticked, from when its samples arrived.

Samples leave a tracker at even intervals and arrive late by what the adapter and the operating system make of it. A
straight line through (index, time) over the last seconds takes that jitter away: least squares, with the sums kept
relative to the newest sample so that they do not lose digits in a long session.
"""

from __future__ import annotations

import math
from collections import deque

#: Samples in the fit: two seconds at 103 Hz.
WINDOW = 206
#: A sample further than this many periods from where the line has it begins a new line (pause, power cycle).
BREAK = 50


class ClockLine:
    """The line of one sensor; ``period_s`` is the interval that was asked for."""

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s  # as fitted
        self._nominal_s = period_s
        self._newest_s = 0.0  # when the newest sample was due
        self._seen: deque[tuple[int, float]] = deque(maxlen=WINDOW)
        self._residual2 = 0.0  # s², sum over all samples of the session
        self._count = 0

    def observe(self, arrived_s: float) -> float:
        """The time (s) at which the sample that arrived at ``arrived_s`` is due on the line.

        Samples that were lost on the way are counted by the time that passed, never by fewer than one.
        """
        index = 0
        if self._seen:
            last, last_s = self._seen[-1]
            if arrived_s - last_s > BREAK * self.period_s:
                self._seen.clear()
                self.period_s = self._nominal_s
            else:
                expected = self._at(last + 1)
                index = last + 1 + max(0, round((arrived_s - expected) / self.period_s))
        self._seen.append((index, arrived_s))
        due = self._fit()
        self._residual2 += (arrived_s - due) ** 2
        self._count += 1
        return due

    @property
    def jitter_s(self) -> float:
        """Root mean square of arrival against the line, over all samples so far."""
        return math.sqrt(self._residual2 / self._count) if self._count else 0.0

    def _at(self, index: int) -> float:
        newest, _ = self._seen[-1]
        return self._newest_s + (index - newest) * self.period_s

    def _fit(self) -> float:
        """Least squares over the window; sets the fitted time of the newest sample and, from ten on, the period."""
        newest, newest_s = self._seen[-1]
        n = len(self._seen)
        sum_i = sum(i - newest for i, _ in self._seen)
        sum_t = math.fsum(t - newest_s for _, t in self._seen)
        if n >= 10:
            sum_ii = sum((i - newest) ** 2 for i, _ in self._seen)
            sum_it = math.fsum((i - newest) * (t - newest_s) for i, t in self._seen)
            self.period_s = (n * sum_it - sum_i * sum_t) / (n * sum_ii - sum_i * sum_i)
        self._newest_s = newest_s + (sum_t - self.period_s * sum_i) / n
        return self._newest_s
