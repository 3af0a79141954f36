"""When a device's clock ticked, from when its samples arrived.

Samples leave a tracker at even intervals and arrive late by what the adapter and the operating system make of it. A
straight line through (index, time) over the last seconds takes that jitter away: least squares with weights that fade,
each sample's being 1 - 1/``WINDOW`` of the next one's. The sums are kept relative to the newest sample, so they do not
lose digits in a long session.
"""

from __future__ import annotations

import math

#: Samples that count: two seconds at 103 Hz.
WINDOW = 206
FADE = 1.0 - 1.0 / WINDOW
#: From so many samples on the period is fitted, too.
ENOUGH = 10
#: A device keeps the period that was asked for within this share of it, assumed. What a busy machine hands over at once
#: would seem to have next to none, and all that follow would seem to come after lost ones.
TRUE_TO = 0.05
CATCH_UP = 8
#: Before so many samples nothing counts as lost: what came together at the start has bent the line until then.
SETTLED = 3 * WINDOW
#: A sample so many periods after the last begins a new line (pause, power cycle).
BREAK = 50


class ClockLine:
    """The line of one sensor; ``period_s`` is the interval that was asked for, then the one that was fitted."""

    def __init__(self, period_s: float) -> None:
        self.period_s = period_s
        self._nominal_s = period_s
        self._residual2 = 0.0  # s², sum over all samples of the session
        self._count = 0
        self._intervals = 0  # between samples of one line, and how long they took together
        self._lasted_s = 0.0
        self._mark = (0, 0.0, 0)  # the newest sample's number on its line, when it was due, the number of the line
        self._begin(0.0)

    def _begin(self, time_s: float) -> None:
        self.period_s = self._nominal_s
        self._newest_s = time_s  # when the newest sample arrived
        self._due_s = time_s  # when it was due
        self._seen = 0
        self._late: list[float] = []  # by how many periods the last samples came after their time, if all of them did
        # Weighted sums of 1, i, t, i² and i t, relative to the newest sample.
        self._n = self._i = self._t = self._ii = self._it = 0.0

    def observe(self, arrived_s: float) -> float:
        """The time (s) at which the sample that arrived at ``arrived_s`` is due on the line.

        A late sample may have waited in the adapter with those after it, which then catch up, or others before it may
        be lost, and then none does: so many are counted as lost when ``CATCH_UP`` in a row were late.
        """
        if self._seen == 0 or arrived_s - self._newest_s > BREAK * self.period_s:
            self._begin(arrived_s)
            number, line = 0, self._mark[2] + 1
        else:
            steps = 1 + self._lost(arrived_s)
            number, line = self._mark[0] + steps, self._mark[2]
            self._shift(steps, arrived_s - self._newest_s)
            self._intervals += 1
            self._lasted_s += arrived_s - self._newest_s
        self._seen += 1
        self._n += 1.0
        self._newest_s = arrived_s
        if self._seen >= ENOUGH:
            fitted_s = (self._n * self._it - self._i * self._t) / (self._n * self._ii - self._i * self._i)
            low_s, high_s = (1.0 - TRUE_TO) * self._nominal_s, (1.0 + TRUE_TO) * self._nominal_s
            self.period_s = min(max(fitted_s, low_s), high_s)
        self._due_s = arrived_s + (self._t - self.period_s * self._i) / self._n
        self._residual2 += (arrived_s - self._due_s) ** 2
        self._count += 1
        self._mark = (number, self._due_s, line)
        return self._due_s

    def read(self, now_s: float) -> tuple[float, int]:
        """How many samples the device's clock says at ``now_s``, and since which of its beginnings; from any thread."""
        number, due_s, line = self._mark
        return number + (now_s - due_s) / self.period_s, line

    def _lost(self, arrived_s: float) -> int:
        """How many samples are known by now to have been lost."""
        late = (arrived_s - self._due_s) / self.period_s - 1.0
        self._late = [*self._late[1 - CATCH_UP :], late] if late >= 0.5 else []
        if len(self._late) < CATCH_UP or self._seen < SETTLED:
            return 0
        lost = round(min(self._late))
        self._late = []
        return lost

    def _shift(self, steps: int, seconds: float) -> None:
        """Let the sums fade and take them relative to a sample ``steps`` and ``seconds`` after the newest."""
        n, i, t, ii, it = (FADE * s for s in (self._n, self._i, self._t, self._ii, self._it))
        self._n = n
        self._i, self._t = i - n * steps, t - n * seconds
        self._ii = ii - 2.0 * steps * i + n * steps * steps
        self._it = it - steps * t - seconds * i + n * steps * seconds

    @property
    def jitter_s(self) -> float | None:
        """Root mean square of arrival against the line, over all samples so far.

        None where they came at another rate than the one that was asked for: the line is not theirs.
        """
        if abs(self.rate_hz * self._nominal_s - 1.0) > TRUE_TO:
            return None
        return math.sqrt(self._residual2 / self._count)

    @property
    def rate_hz(self) -> float:
        """Samples that arrived by time, pauses left out; 0 before there are two."""
        return self._intervals / self._lasted_s if self._lasted_s > 0.0 else 0.0
