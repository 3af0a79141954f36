"""miniBIRDs and a closure sensor as the instruments of a session.

A bird without a fresh sample that is not flawed counts as not seen (:mod:`trainer.drivers.in_hand`).
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass

import numpy as np

from trainer.config import ConfigError
from trainer.drivers.clock_line import ClockLine
from trainer.drivers.closure import ClosureSensor
from trainer.drivers.in_hand import SWITCH_S, Latency, Losses, Pace, Placer
from trainer.drivers.latency import LatencyCount
from trainer.drivers.minibird_flock import UNHURRIED, Silences
from trainer.drivers.minibird_record import Sample
from trainer.drivers.minibird_stream import FlockStream
from trainer.geometry import quaternion_conjugate
from trainer.poses import ToolPoses
from trainer.profile import Bird, ClosureSpec, MinibirdSpec

#: A sample older than this no longer says where the hand is: ten records in a row, assumed.
STALE_S = 0.1


@dataclass
class _Instrument:
    """One bird's way into the scene, and what became of it so far."""

    bird: Bird
    tool: int
    newest: Sample | None = None  # the last without flaw; written by the thread that reads
    flaw: str = ""  # of the last sample; written by the same thread
    used: Sample | None = None


class Minibird:
    """Driver of a profile with a table [minibird]."""

    def __init__(
        self,
        spec: MinibirdSpec,
        closure: ClosureSpec | None,
        tools: Sequence[str],
        tick_hz: float,
        home: ToolPoses,
        silences: Silences = UNHURRIED,
    ) -> None:
        """Connects and configures; the stream begins with the first poll. Raises ConfigError, DeviceError."""
        self._placer = Placer(spec, home)
        self._instruments = [_Instrument(bird, tools.index(bird.tool)) for bird in spec.bird if bird.tool in tools]
        if not self._instruments:
            raise ConfigError(
                f"the device moves {', '.join(b.tool for b in spec.bird)}; the task has {', '.join(tools)}"
            )
        self._by_address = {instrument.bird.address: instrument for instrument in self._instruments}
        self._pace = Pace(tick_hz)
        self._home = home
        self._position, self._quaternion = home.position.copy(), home.quaternion.copy()
        self._jaws = home.closure.copy()
        self._line = ClockLine(1.0 / spec.rate_hz)
        self._latency = Latency()
        self._losses = Losses(self._pace.tick_s)
        self._tick, self._polled_s = 0, 0.0  # this tick, and when it began
        self._rate_hz = spec.rate_hz
        with ExitStack() as opened:
            self._closure = opened.enter_context(closing(ClosureSensor(closure))) if closure is not None else None
            self._stream = opened.enter_context(closing(FlockStream(spec, self._take, silences)))
            if self._closure is not None:
                self._closure.wait()
            opened.pop_all()
        # A thread that reads must not wait 5 ms for one that computes.
        self._switch_s = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)

    def _take(self, sample: Sample) -> None:
        """A sample, on the thread that read it."""
        instrument = self._by_address.get(sample.address)
        if instrument is None:
            return
        instrument.flaw = sample.flaw
        if not sample.flaw:
            instrument.newest = sample
            if instrument is self._instruments[0]:
                self._line.observe(sample.sent_s)

    def poll(self, tick: int, view: object) -> ToolPoses | None:
        """The newest poses. Where nobody else paces the session, waits until the tick is due."""
        if self._pace.begun_s is None:
            self._stream.start()
        now = self._pace.wait(tick)
        self._latency.begin()
        self._tick, self._polled_s = tick, now
        valid = np.asarray(self._home.valid, dtype=bool).copy()
        reasons = [""] * len(valid)
        for instrument in self._instruments:
            reasons[instrument.tool] = reason = self._follow(instrument, now)
            valid[instrument.tool] = not reason
            self._losses.note(instrument.bird.tool, tick, reason)
        return ToolPoses(self._position.copy(), self._quaternion.copy(), self._jaws.copy(), valid, tuple(reasons))

    def _follow(self, instrument: _Instrument, now: float) -> str:
        """Bring an instrument to where its bird is; "" or why that is not known."""
        sample, k, tool = instrument.newest, instrument.tool, instrument.bird.tool
        if sample is None:
            return "" if self._pace.starting(now) else self._stream.trouble or "the stream does not start"
        if now - sample.arrived_s > STALE_S:
            return self._stream.trouble or instrument.flaw or "no sample comes"
        jaws, reason = instrument.bird.closure, ""
        if self._closure is not None and self._closure.has(tool):
            jaws, reason = self._closure.closure(tool, now)
        if reason:
            return reason
        if sample is not instrument.used:
            position, turn = np.array(sample.position), np.array(sample.quaternion)
            if self._stream.inverse[sample.address]:
                turn = quaternion_conjugate(turn)
            pose = self._placer.world_from_tool(k, position, turn, instrument.bird)
            if self._closure is not None and self._closure.has(tool):
                self._closure.moved(tool, position, now)
            self._position[k], self._quaternion[k] = pose.position, pose.quaternion
            instrument.used = sample
            self._latency.used(sample.sent_s)
        self._jaws[k] = jaws
        return ""

    def tick(self, record: object) -> None:
        """The events of a tick are with the sinks: how long did its poses take to become them?"""
        self._latency.told()

    @property
    def latency(self) -> LatencyCount:
        """From a pose's first byte to its tick's events, of each pose that was used."""
        return self._latency.count

    def apart_ticks(self) -> tuple[float, int]:
        """The session's clock when this tick began less the device's, in ticks, and which of its beginnings it is.

        The device's clock counts its samples, lost ones too, at the rate that was asked for; it begins with the stream,
        and anew after a pause. How far both come apart later is drift; a tick that begins late is not.
        """
        samples, begun = self._line.read(self._polled_s)
        return self._tick - samples / self._rate_hz / self._pace.tick_s, begun

    def summary(self) -> dict[str, object]:
        """What was read, how late, and when and why it was not."""
        jitter_s = self._line.jitter_s
        return {
            "driver": "minibird",
            "records": dict(sorted(self._stream.counts.items())),
            "measured_rate_hz": round(self._line.rate_hz, 3),
            "jitter_ms": None if jitter_s is None else round(1e3 * jitter_s, 3),
            "latency_ms": self._latency.summary(),
            "restarts": self._stream.restarts,
            **self._losses.summary(),
            "closure": None if self._closure is None else self._closure.summary(),
        }

    def close(self) -> None:
        sys.setswitchinterval(self._switch_s)
        self._stream.close()
        if self._closure is not None:
            self._closure.close()
