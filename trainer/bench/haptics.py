"""Does the haptic loop keep its rate beside a running scene? Against a bare sleeping loop on the same machine.

The bare loop runs at the same time in a process of its own: it waits for absolute deadlines as the haptic loop does,
renders nothing and shares Python's lock with nobody, so what it misses is the machine's doing.
"""

from __future__ import annotations

import multiprocessing
import time
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Event
from typing import Any

import numpy as np

from trainer.geometry import Rigid
from trainer.haptics.loop import BINS_US, HapticLoop, period_report
from trainer.mechanics.density_field import DensityField, density_field, force_at

#: Calls that a single evaluation is timed over, and how often; the fastest counts, since what disturbs only adds.
CALLS, ROUNDS = 10_000, 7


def measure(beside: Callable[[float], object], seconds: float, rate_hz: float = 1000.0) -> dict[str, Any]:
    """Run ``beside(seconds)`` in this thread with the haptic loop next to it, and a bare loop in another process.

    Numbers of the two loops are those of haptics.loop.period_report; ``p999_ratio`` compares them.
    """
    context = multiprocessing.get_context("spawn")
    stop, (here, there) = context.Event(), context.Pipe()
    other = context.Process(target=bare, args=(stop, there, rate_hz), name="bare loop", daemon=True)
    other.start()
    try:
        here.recv()  # its modules are loaded, it is about to begin
        field = ball()
        with HapticLoop(field, rate_hz) as loop:
            loop.tip[:] = 0.0, 0.0, 15.0
            beside(seconds)
            rendered = loop.report()
        stop.set()
        slept = here.recv()
    finally:
        stop.set()
        other.join()
    return {
        "haptics": rendered,
        "bare": slept,
        "p999_ratio": rendered["p999_us"] / slept["p999_us"],
        "evaluation_us": evaluation_us(field),
    }


def bare(stop: Event, answer: Connection, rate_hz: float) -> None:
    """A loop that only sleeps, until it is told to stop; sends the errors of its periods as those of a haptic loop."""
    answer.send("ready")
    counts = np.zeros(BINS_US + 1, dtype=np.int64)
    worst = 0
    period = round(1e9 / rate_hz)
    woken = due = time.monotonic_ns()
    while not stop.is_set():
        due = max(due + period, woken - 10 * period)
        while (now := time.monotonic_ns()) < due:
            time.sleep((due - now) * 1e-9)
        error = abs(now - woken - period)
        woken = now
        worst = max(worst, error)
        counts[min(error // 1000, BINS_US)] += 1
    answer.send(period_report(rate_hz, counts, worst))


def ball() -> DensityField:
    """A bony ball of 15 mm in 256 × 256 × 124 voxels of half a millimetre, the paper's grid."""
    i, j, k = np.ogrid[:256, :256, :124]
    inside = (i - 127.5) ** 2 + (j - 127.5) ** 2 + (k - 61.5) ** 2 < 30.0**2
    middle = Rigid(-0.5 * np.array([127.5, 127.5, 61.5]), Rigid.identity().quaternion)
    return density_field(inside, (0.5, 0.5, 0.5), middle, 500.0, 3300.0)


def evaluation_us(field: DensityField) -> float:
    """One call of the force from Python, µs."""
    tip, force, direction = np.array([0.0, 0.0, 15.0]), np.zeros(3), np.zeros(3)
    density, constants = field.density, field.constants
    took = []
    for _ in range(ROUNDS):
        begun = time.perf_counter()
        for _ in range(CALLS):
            force_at(density, constants, tip, force, direction)
        took.append((time.perf_counter() - begun) / CALLS)
    return min(took) * 1e6
