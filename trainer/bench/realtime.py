"""Does a task keep its pace? Sessions in real time, one after the other, and the work of all their ticks."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable
from functools import partial
from typing import Any

from trainer.clock import Realtime, pace

#: Performs one session, given its number, its clock and a function that says when to stop; returns its outcome.
Perform = Callable[[int, Realtime, Callable[[], bool]], str]


def measure(perform: Perform, tick_hz: float, seconds: float) -> dict[str, Any]:
    """Repeat sessions until they have ticked for ``seconds``; the last one is cut short then.

    Pauses between sessions do not count. A session that was stopped by its trainee (Ctrl-C) is the last one, too.
    """
    wanted = math.ceil(seconds * tick_hz)
    work_ms = array("d")
    sessions: list[str] = []
    while len(work_ms) < wanted:
        clock = Realtime(tick_hz)
        enough = partial(_reached, clock, wanted - len(work_ms))
        outcome = perform(len(sessions), clock, enough)
        work_ms.extend(clock.work_ms)
        sessions.append("cut short" if outcome == "aborted" else outcome)
        if outcome == "aborted":
            break
    return {"seconds": len(work_ms) / tick_hz, "ticks": len(work_ms), "sessions": sessions, **pace(tick_hz, work_ms)}


def _reached(clock: Realtime, ticks: int) -> bool:
    return len(clock.work_ms) >= ticks
