"""Does a station last? Practice through simulated devices, in real time, for as long as asked.

A tracker pair and a closure sensor are played byte for byte on pseudo-terminals by another process, and move as the
scripted expert did. For half of the time the stitch is sewn again and again, a session each; the second half is one
session, in which the hands rest after the stitch. Once a second the gauges are read:

* memory of this process and of the one that writes the session's recording (resident sets, which count what they share
  twice), its slope by least squares from the end of the first session on, and in the last session after its first
  twenty seconds;
* ticks that wait for the log's thread and messages that wait for room in the pipe to the recording's process, which is
  another one for each session; the device has no queue, its newest pose wins;
* drift: ticks by which the session's clock and the device's (its samples, counted at the rate it was asked for) have
  come apart since both began. A session on a machine that is too slow for it goes on from where it is, which shows
  here as well.

A pose's latency is the time from its first byte to its tick's events being out, by the driver. The device's clock is
this machine's, so drift is what bytes, threads and pacing make of it, not what a tracker's crystal does.
"""

from __future__ import annotations

import math
import os
import re
import subprocess
import sys
import time
from array import array
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from trainer.clock import Realtime
from trainer.drivers.latency import LatencyCount
from trainer.drivers.minibird import Minibird

EVERY_S = 1.0  # between two looks at the gauges
TOLD_EVERY_S = 30.0
SETTLED = 7  # seconds after which the line through the device's samples stands: three of its windows
PROFILE = "minibird-pair"
#: A step that the resting hands never reach: needle and thread are out of every hole again.
REST = '[[step]]\nname = "rest"\nkind = "withdraw"\n\n'


@runtime_checkable
class Queued(Protocol):
    """A sink with a queue."""

    @property
    def waiting(self) -> int: ...


@runtime_checkable
class Helped(Protocol):
    """A sink with a process of its own."""

    @property
    def pid(self) -> int: ...


@dataclass
class Session:
    """What became of one session."""

    outcome: str = ""
    ticks: int = 0
    overruns: int = 0
    losses: int = 0  # of an instrument
    drift_ticks: float = 0.0  # the most, either way
    waiting: dict[str, int] = field(default_factory=dict)  # the most, by sink


@dataclass
class Soak:
    """All that was measured so far."""

    sessions: list[Session] = field(default_factory=list)
    at_s: array[float] = field(default_factory=lambda: array("d"))  # when the gauges were read, s from the start
    rss_mb: array[float] = field(default_factory=lambda: array("d"))
    session_of: array[int] = field(default_factory=lambda: array("l"))  # in which session
    latency: LatencyCount = field(default_factory=LatencyCount)
    work_ms: array[float] = field(default_factory=lambda: array("d"))
    began_s: float = math.inf  # when the first session's device was there
    told_s: float = 0.0  # when progress was last told

    def begin(self) -> None:
        """The time begins, unless it runs already: what opening the first device takes is no practice."""
        self.began_s = min(self.began_s, time.monotonic())
        self.told_s = max(self.told_s, self.began_s)

    def elapsed_s(self) -> float:
        return max(0.0, time.monotonic() - self.began_s)


class Gauges:
    """A sink that reads them once a second, and tells of them now and then."""

    def __init__(self, soak: Soak, driver: object, sinks: Sequence[object], tell: Callable[[str], None]) -> None:
        soak.begin()
        self._soak, self._driver, self._tell = soak, driver, tell
        self._queues = {type(sink).__name__: sink for sink in sinks if isinstance(sink, Queued)}
        self._processes = [os.getpid(), *(sink.pid for sink in sinks if isinstance(sink, Helped))]
        self._session = soak.sessions[-1]
        self._due_s = time.monotonic()
        self._apart = -math.inf  # session's clock less the device's in this second, ticks: that of the least late tick
        self._seconds = 0  # since the device's clock began
        self._line = 0
        self._at_first = 0.0

    def tick(self, record: object) -> None:
        for name, sink in self._queues.items():
            self._session.waiting[name] = max(self._session.waiting.get(name, 0), sink.waiting)
        if isinstance(self._driver, Minibird):
            apart, line = self._driver.apart_ticks()
            if line != self._line:
                self._line, self._seconds = line, 0
            self._apart = max(self._apart, apart)
        now = time.monotonic()
        if now < self._due_s:
            return
        self._due_s = now + EVERY_S
        soak = self._soak
        soak.at_s.append(soak.elapsed_s())
        soak.rss_mb.append(rss_mb(self._processes))
        soak.session_of.append(len(soak.sessions) - 1)
        self._drift()
        if now - soak.told_s >= TOLD_EVERY_S:
            soak.told_s = now
            self._tell(
                f"{soak.elapsed_s() / 60.0:5.1f} min, session {len(soak.sessions)}, {soak.rss_mb[-1]:.0f} MB, "
                f"drift {self._session.drift_ticks:.2f} ticks"
            )

    def _drift(self) -> None:
        """A second is over: how far have the clocks come apart since the device's was settled?"""
        apart, self._apart = self._apart, -math.inf
        self._seconds += 1
        if self._seconds <= SETTLED:
            self._at_first = apart
        elif math.isfinite(apart):
            self._session.drift_ticks = max(self._session.drift_ticks, abs(apart - self._at_first))

    def close(self) -> None:
        """Nothing stays open."""


Observed = Callable[[Any, Sequence[Any]], Gauges]
#: Performs one session, given the device's profile, its clock, when to stop, what looks at device and sinks, and
#: whether it goes on after the stitch; returns what ``trainer practice --json`` prints.
Perform = Callable[[Path, Realtime, Callable[[], bool], Observed, bool], dict[str, Any]]


def measure(
    soak: Soak, perform: Perform, folder: Path, motion: str, tick_hz: float, minutes: float, tell: Callable[[str], None]
) -> None:
    """Fill ``soak``: sessions for half of the time, then one for the rest of it. Ctrl-C in a session ends all."""
    ends_s = 60.0 * minutes
    while soak.elapsed_s() < ends_s:
        long = soak.elapsed_s() >= 0.5 * ends_s
        session, clock = Session(), Realtime(tick_hz)
        devices: list[Any] = []
        soak.sessions.append(session)

        def observed(device: Any, sinks: Sequence[Any], devices: list[Any] = devices) -> Gauges:
            devices.append(device)
            return Gauges(soak, device, sinks, tell)

        try:
            with played(folder / f"station{len(soak.sessions)}", motion) as profile:
                done = perform(profile, clock, lambda: soak.elapsed_s() >= ends_s, observed, long)
            session.outcome, session.losses = str(done["outcome"]), int(done["device"]["losses"])
        finally:
            soak.work_ms.extend(clock.work_ms)
            session.ticks, session.overruns = len(clock.work_ms), int(clock.report()["overruns"])
            for device in devices:
                soak.latency.merge(device.latency)
        if session.outcome == "aborted" and soak.elapsed_s() < ends_s:
            return


def with_rest(text: str, minutes: float) -> str:
    """A task's text with a last step that is not reached, and time for it."""
    text = re.sub(r"(?m)^time_limit_s = .*$", f"time_limit_s = {60.0 * minutes + 60.0!r}", text)
    before, metric, after = text.partition("[[metric]]")
    return before + REST + metric + after


@contextmanager
def played(folder: Path, motion: str) -> Iterator[Path]:
    """``trainer devices simulate`` in a process and a process group of its own; its profile. Raises OSError."""
    command = [sys.executable, "-m", "trainer", "devices", "simulate", PROFILE, "--out", str(folder)]
    process = subprocess.Popen(
        [*command, "--motion", motion], stdout=subprocess.PIPE, text=True, start_new_session=True
    )
    assert process.stdout is not None
    try:
        written = process.stdout.readline().strip()
        if not written:
            raise OSError(f"{folder}: the simulated devices do not start")
        yield Path(written)
    finally:
        process.terminate()
        process.communicate()


def rss_mb(processes: Sequence[int]) -> float:
    """What they hold in memory together, MB; of this process alone, and its most so far, where no more is told."""
    if Path("/proc/self/statm").exists():
        pages = 0
        for process in processes:
            with suppress(OSError):  # it has ended
                pages += int(Path(f"/proc/{process}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1e6 if sys.platform == "darwin" else 1e3)
