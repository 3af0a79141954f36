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
    rate_hz: float | None  # records a second
    interval_median_ms: float | None
    interval_p99_ms: float | None
    interval_max_ms: float | None
    jitter_ms: float | None  # standard deviation of the intervals in which nothing is known to be lost
    lost: int | None  # records that should have arrived, and did not
    loss_percent: float | None  # of all that should have arrived


def arrival(
    time: Array,
    frame_number: np.ndarray | None = None,
    nominal_hz: float | None = None,
    span: tuple[float, float] | None = None,
) -> Arrival:
    """Rate, jitter and loss of records that arrived at ``time`` (n,), s, never decreasing.

    Lost is what the device's own count ``frame_number`` (n,) jumps over. Where a device does not count, it is what is
    missing of ``nominal_hz``, to one or two records; with neither, nothing is said about losses. ``span`` is from when
    to when the stream was listened to, where it was silent at an end; else it is from the first record to the last.
    """
    n = len(time)
    begun, ended = span or ((float(time[0]), float(time[-1])) if n else (0.0, 0.0))
    duration = ended - begun
    lost = None
    if nominal_hz is not None:
        lost = max(0, round(duration * nominal_hz) + 1 - n)
    if n < 2:
        return Arrival(n, duration, None, None, None, None, None, lost, _percent(lost, n))
    interval = np.diff(time)
    steady = interval
    if frame_number is not None:
        skipped = np.maximum(np.diff(frame_number) - 1, 0)
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
        lost=lost,
        loss_percent=_percent(lost, n),
    )


def _percent(lost: int | None, n: int) -> float | None:
    return None if lost is None or not lost + n else 100.0 * lost / (lost + n)


@dataclass(frozen=True)
class Seen:
    """What one sensor last said, and how often it was seen at all."""

    seen_percent: float
    position_mm: tuple[float, float, float] | None  # the last that was seen, device frame
    closure: float | None  # the last, 0 open … 1 closed; None where no jaws are measured


def seen(position: Array, ok: np.ndarray, closure: Array | None, lost: int = 0) -> Seen:
    """Of one sensor's records: ``position`` (n, 3) mm, ``ok`` (n,) bool, ``closure`` (n,); ``lost`` more are not."""
    last = np.flatnonzero(ok)
    where = None
    if len(last):
        x, y, z = position[last[-1]].tolist()
        where = (x, y, z)
    due = len(ok) + lost
    part = 100.0 * len(last) / due if due else 0.0
    return Seen(part, where, float(closure[-1]) if closure is not None and len(closure) else None)
