"""How well a stream of poses arrives: its rate, its jitter, and what was lost on the way."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trainer.geometry import Array


@dataclass(frozen=True)
class Arrival:
    """What the times of a stream's records say; None where there are too few of them to say it."""

    records: int
    duration_s: float
    rate_hz: float | None  # records a second, from the first to the last
    interval_median_ms: float | None
    interval_p99_ms: float | None
    interval_max_ms: float | None
    jitter_ms: float | None  # standard deviation of the intervals in which nothing was lost
    lost: int | None  # records that should have arrived, and did not
    loss_percent: float | None  # of all that should have arrived


def arrival(time: Array, frame_number: np.ndarray | None = None, nominal_hz: float | None = None) -> Arrival:
    """Rate, jitter and loss of records that arrived at ``time`` (n,), s, never decreasing.

    Lost is what the device's own count ``frame_number`` (n,) jumps over. Where a device does not count, an interval of
    k periods of its ``nominal_hz``, rounded, has lost k - 1 records. With neither, nothing is said about losses.
    """
    n = len(time)
    duration = float(time[-1] - time[0]) if n else 0.0
    if n < 2:
        return Arrival(n, duration, None, None, None, None, None, None, None)
    interval = np.diff(time)
    skipped = np.zeros(n - 1)
    if frame_number is not None:
        skipped = np.maximum(np.diff(frame_number) - 1, 0)
    elif nominal_hz is not None:
        skipped = np.maximum(np.round(interval * nominal_hz) - 1, 0)
    counted = frame_number is not None or nominal_hz is not None
    lost = int(skipped.sum())
    steady = interval[skipped == 0]
    return Arrival(
        records=n,
        duration_s=duration,
        rate_hz=(n - 1) / duration if duration > 0.0 else None,
        interval_median_ms=1e3 * float(np.median(interval)),
        interval_p99_ms=1e3 * float(np.percentile(interval, 99)),
        interval_max_ms=1e3 * float(interval.max()),
        jitter_ms=1e3 * float(np.std(steady)) if len(steady) else None,
        lost=lost if counted else None,
        loss_percent=100.0 * lost / (lost + n) if counted else None,
    )


@dataclass(frozen=True)
class Seen:
    """What one sensor last said, and how often it was seen at all."""

    seen_percent: float
    position_mm: tuple[float, float, float] | None  # the last that was seen, device frame
    closure: float | None  # the last, 0 open … 1 closed; None where no jaws are measured


def seen(position: Array, ok: np.ndarray, closure: Array | None) -> Seen:
    """Of one sensor's records: ``position`` (n, 3) mm, ``ok`` (n,) bool, ``closure`` (n,)."""
    last = np.flatnonzero(ok)
    where = None
    if len(last):
        x, y, z = position[last[-1]].tolist()
        where = (x, y, z)
    part = 100.0 * len(last) / len(ok) if len(ok) else 0.0
    return Seen(part, where, float(closure[-1]) if closure is not None and len(closure) else None)
