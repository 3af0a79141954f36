"""miniBIRDs and a closure sensor as the instruments of a session.

The loop takes the newest pose of each bird and never waits for one. A bird without a fresh sample that is not flawed
counts as not seen: the scene leaves the instrument where it is, jaws and all, and the summary says why and how long.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass, field

import numpy as np

from trainer.config import ConfigError
from trainer.drivers import field_distortion
from trainer.drivers.clock_line import ClockLine
from trainer.drivers.closure import ClosureSensor
from trainer.drivers.latency import LatencyCount
from trainer.drivers.minibird_flock import UNHURRIED, Silences
from trainer.drivers.minibird_record import Sample
from trainer.drivers.minibird_stream import FlockStream
from trainer.geometry import Rigid, quaternion_conjugate, quaternion_from_euler_deg
from trainer.poses import ToolPoses
from trainer.profile import Bird, ClosureSpec, MinibirdSpec

#: A sample older than this no longer says where the hand is: ten records in a row, assumed.
STALE_S = 0.1
#: The stream's first sample may take this long after the session began.
FIRST_S = 0.5
#: How long a thread computes before it lets one that has read something have a turn; 5 ms by default. Assumed.
SWITCH_S = 0.0005
#: As many losses are told one by one; a worse session is told by their number.
MOST_LOSSES = 100
MOST_REASONS = 4  # of one loss


@dataclass
class _Instrument:
    """One bird's way into the scene, and what became of it so far."""

    bird: Bird
    tool: int
    sensor_from_tool: Rigid
    newest: Sample | None = None  # the last without flaw; written by the thread that reads
    flaw: str = ""  # of the last sample; written by the same thread
    used: Sample | None = None
    anchor: Rigid | None = None
    lost_tick: int | None = None
    reasons: list[str] = field(default_factory=list)  # why, as far as it is known by now


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
        self._spec = spec
        self._scene_from_device = _rigid(spec)
        self._instruments = [
            _Instrument(bird, tools.index(bird.tool), _rigid(bird)) for bird in spec.bird if bird.tool in tools
        ]
        if not self._instruments:
            raise ConfigError(
                f"the device moves {', '.join(b.tool for b in spec.bird)}; the task has {', '.join(tools)}"
            )
        self._by_address = {instrument.bird.address: instrument for instrument in self._instruments}
        self._tick_s = 1.0 / tick_hz
        self._home = home
        self._position, self._quaternion = home.position.copy(), home.quaternion.copy()
        self._jaws = home.closure.copy()
        self._begun_s: float | None = None
        self._line = ClockLine(1.0 / spec.rate_hz)
        self.latency = LatencyCount()  # from a pose's first byte to its tick's events, of each pose that was used
        self._polled_s = 0.0  # when this tick began
        self._fresh: list[Sample] = []  # poses that this tick uses and none used before
        self._ticks = 0
        self._losses: list[dict[str, object]] = []
        self._lost_count = 0
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
        now = time.monotonic()
        if self._begun_s is None:
            self._begun_s = now
            self._stream.start()
        # Half a tick early is early enough: a clock that paces the session has waited already.
        ahead_s = self._begun_s + (tick - 0.5) * self._tick_s - now
        if ahead_s > 0.0:
            time.sleep(ahead_s)
            now = time.monotonic()
        self._ticks, self._polled_s = tick, now
        self._fresh.clear()
        valid = np.asarray(self._home.valid, dtype=bool).copy()
        reasons = [""] * len(valid)
        for instrument in self._instruments:
            reasons[instrument.tool] = reason = self._follow(instrument, now)
            valid[instrument.tool] = not reason
            self._note(instrument, tick, reason)
        return ToolPoses(self._position.copy(), self._quaternion.copy(), self._jaws.copy(), valid, tuple(reasons))

    def _follow(self, instrument: _Instrument, now: float) -> str:
        """Bring an instrument to where its bird is; "" or why that is not known."""
        sample, k, tool = instrument.newest, instrument.tool, instrument.bird.tool
        assert self._begun_s is not None
        if sample is None:
            return "" if now - self._begun_s <= FIRST_S else self._stream.trouble or "the stream does not start"
        if now - sample.arrived_s > STALE_S:
            return self._stream.trouble or instrument.flaw or "no sample comes"
        jaws, reason = instrument.bird.closure, ""
        if self._closure is not None and self._closure.has(tool):
            jaws, reason = self._closure.closure(tool, now)
        if reason:
            return reason
        if sample is not instrument.used:
            pose = self._place(instrument, sample)
            if self._closure is not None and self._closure.has(tool) and instrument.used is not None:
                self._closure.moved(tool, math.dist(sample.position, instrument.used.position), now)
            self._position[k], self._quaternion[k] = pose.position, pose.quaternion
            instrument.used = sample
            self._fresh.append(sample)
        self._jaws[k] = jaws
        return ""

    def _place(self, instrument: _Instrument, sample: Sample) -> Rigid:
        """world_from_tool = anchor · scene_from_device · (scale · position, rotation) · sensor_from_tool."""
        turn = np.array(sample.quaternion)
        if self._stream.inverse[instrument.bird.address]:
            turn = quaternion_conjugate(turn)
        position = field_distortion.correct(np.array([sample.position]), self._spec.distortion)[0]
        device_from_sensor = Rigid(self._spec.scale * position, turn)
        pose = self._scene_from_device @ device_from_sensor @ instrument.sensor_from_tool
        if self._spec.anchor == "none":
            return pose
        if instrument.anchor is None:
            instrument.anchor = self._home.world_from_tool(instrument.tool) @ pose.inverse()
        return instrument.anchor @ pose

    def _note(self, instrument: _Instrument, tick: int, reason: str) -> None:
        """Keep account of when and why an instrument was lost."""
        if reason and instrument.lost_tick is None:
            instrument.lost_tick, instrument.reasons = tick, []
        if reason:
            # First nothing comes, then it turns out why.
            if reason not in instrument.reasons and len(instrument.reasons) < MOST_REASONS:
                instrument.reasons.append(reason)
        elif instrument.lost_tick is not None:
            self._lost_count += 1
            if len(self._losses) < MOST_LOSSES:
                self._losses.append(_loss(instrument, tick - instrument.lost_tick, self._tick_s))
            instrument.lost_tick = None

    def tick(self, record: object) -> None:
        """The events of a tick are with the sinks: how long did its poses take to become them?"""
        now = time.monotonic()
        for sample in self._fresh:
            self.latency.add(1e3 * (now - sample.sent_s))
        self._fresh.clear()

    def apart_ticks(self) -> tuple[float, int]:
        """The session's clock when this tick began less the device's, in ticks, and which of its beginnings it is.

        The device's clock counts its samples, lost ones too, at the rate that was asked for; it begins with the stream,
        and anew after a pause. How far both come apart later is drift; a tick that begins late is not.
        """
        samples, begun = self._line.read(self._polled_s)
        return (self._ticks * self._tick_s - samples / self._spec.rate_hz) / self._tick_s, begun

    def summary(self) -> dict[str, object]:
        """What was read, how late, and when and why it was not."""
        still = [i for i in self._instruments if i.lost_tick is not None]
        return {
            "driver": "minibird",
            "records": dict(sorted(self._stream.counts.items())),
            "measured_rate_hz": round(1.0 / self._line.period_s, 3),
            "jitter_ms": round(1e3 * self._line.jitter_s, 3),
            "latency_ms": self.latency.summary(),
            "restarts": self._stream.restarts,
            "losses": self._lost_count + len(still),
            "lost": self._losses + [_loss(i, self._ticks + 1 - (i.lost_tick or 0), self._tick_s) for i in still],
            "closure": None if self._closure is None else self._closure.summary(),
        }

    def close(self) -> None:
        sys.setswitchinterval(self._switch_s)
        self._stream.close()
        if self._closure is not None:
            self._closure.close()


def _rigid(placed: MinibirdSpec | Bird) -> Rigid:
    return Rigid(np.array(placed.position_mm), quaternion_from_euler_deg(placed.rotation_deg))


def _loss(instrument: _Instrument, ticks: int, tick_s: float) -> dict[str, object]:
    return {
        "tool": instrument.bird.tool,
        "tick": instrument.lost_tick,
        "lost_s": round(ticks * tick_s, 3),
        "reason": "; ".join(instrument.reasons),
    }
