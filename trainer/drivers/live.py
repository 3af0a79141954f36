"""Instruments moved by a device in a hand, whichever device it is: the newest pose of each sensor wins.

A sensor without a fresh reading that is not flawed counts as not seen (:mod:`trainer.drivers.in_hand`).
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from trainer.config import ConfigError
from trainer.drivers.closure import ClosureSensor
from trainer.drivers.in_hand import SWITCH_S, Latency, Losses, Pace, Placer
from trainer.drivers.latency import LatencyCount
from trainer.geometry import Array
from trainer.poses import ToolPoses
from trainer.profile import Bird, ClosureSpec, Registration, Tracked


@dataclass(frozen=True)
class Reading:
    """What a device says of one of its sensors."""

    name: str
    arrived_s: float
    position: Array  # (3,) mm, device frame
    quaternion: Array  # (4,) wxyz
    closure: float | None = None  # where the device knows of jaws
    flaw: str = ""  # why this is no pose
    on_the_way_s: float = 0.0  # how long it took to arrive, where that is known


class Source(Protocol):
    """An open device. Its own threads read it, and open it again when it is gone, until it is closed."""

    @property
    def stale_s(self) -> float:
        """A reading older than this no longer says where the hand is."""
        ...

    @property
    def newest(self) -> Mapping[str, Reading]:
        """By sensor, the last reading without flaw."""
        ...

    def begin(self) -> None:
        """The session begins: readings are wanted from now on."""
        ...

    def silence(self, sensor: str) -> str:
        """Why no fresh reading of a sensor comes."""
        ...

    def summary(self) -> dict[str, object]:
        """The driver's name and what was read, ready for JSON."""
        ...

    def close(self) -> None: ...


def check_tools(moved: Sequence[str], tools: Sequence[str]) -> None:
    """Raises ConfigError where a device moves none of the task's instruments."""
    if not set(moved) & set(tools):
        raise ConfigError(f"the device moves {', '.join(moved)}; the task has {', '.join(tools)}")


class LivePoses:
    """Driver of the device that ``open_source`` opens; raises what it raises, ConfigError or DeviceError."""

    def __init__(
        self,
        open_source: Callable[[], Source],
        registration: Registration,
        sensors: Sequence[Tracked] | Sequence[Bird],
        closure: ClosureSpec | None,
        tools: Sequence[str],
        tick_hz: float,
        home: ToolPoses,
    ) -> None:
        check_tools([sensor.tool for sensor in sensors], tools)
        self._sensors = [(sensor, tools.index(sensor.tool)) for sensor in sensors if sensor.tool in tools]
        self._home = home
        self._position, self._quaternion = home.position.copy(), home.quaternion.copy()
        self._jaws = home.closure.copy()
        self._pace = Pace(tick_hz)
        self._placer = Placer(registration, home)
        self._latency = Latency()
        self._losses = Losses(self._pace.tick_s)
        self._used: dict[str, Reading] = {}
        self._tick, self._polled_s = 0, 0.0  # this tick, and when it began
        with ExitStack() as opened:
            self._closure = opened.enter_context(closing(ClosureSensor(closure))) if closure is not None else None
            self._source = opened.enter_context(closing(open_source()))
            if self._closure is not None:
                self._closure.wait()
            opened.pop_all()
        # A thread that reads must not wait 5 ms for one that computes.
        self._switch_s = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)

    def poll(self, tick: int, view: object) -> ToolPoses | None:
        """The newest poses. Where nobody else paces the session, waits until the tick is due."""
        if self._pace.begun_s is None:
            self._source.begin()
        now = self._pace.wait(tick)
        self._latency.begin()
        self._tick, self._polled_s = tick, now
        valid = np.asarray(self._home.valid, dtype=bool).copy()
        reasons = [""] * len(valid)
        for sensor, k in self._sensors:
            reasons[k] = reason = self._follow(sensor, k, now)
            valid[k] = not reason
            self._losses.note(sensor.tool, tick, reason)
        return ToolPoses(self._position.copy(), self._quaternion.copy(), self._jaws.copy(), valid, tuple(reasons))

    def _follow(self, sensor: Tracked | Bird, k: int, now: float) -> str:
        """Bring an instrument to where its sensor is; "" or why that is not known."""
        reading = self._source.newest.get(sensor.name)
        if reading is None and self._pace.starting(now):
            return ""
        if reading is None or now - reading.arrived_s > self._source.stale_s:
            return self._source.silence(sensor.name)
        jaws, reason = sensor.closure if reading.closure is None else reading.closure, ""
        measured = self._closure if self._closure is not None and self._closure.has(sensor.tool) else None
        if measured is not None:
            jaws, reason = measured.closure(sensor.tool, now)
        if reason:
            return reason
        if reading is not self._used.get(sensor.name):
            pose = self._placer.world_from_tool(k, reading.position, reading.quaternion, sensor)
            if measured is not None:
                measured.moved(sensor.tool, reading.position, now)
            self._position[k], self._quaternion[k] = pose.position, pose.quaternion
            self._used[sensor.name] = reading
            self._latency.used(reading.arrived_s - reading.on_the_way_s)
        self._jaws[k] = jaws
        return ""

    def tick(self, record: object) -> None:
        """The events of a tick are with the sinks: how long did its poses take to become them?"""
        self._latency.told()

    @property
    def latency(self) -> LatencyCount:
        """From when a pose was sent to its tick's events, of each pose that was used."""
        return self._latency.count

    def summary(self) -> dict[str, object]:
        """What was read, how late, and when and why it was not."""
        return {
            **self._source.summary(),
            "latency_ms": self._latency.summary(),
            **self._losses.summary(),
            "closure": None if self._closure is None else self._closure.summary(),
        }

    def close(self) -> None:
        sys.setswitchinterval(self._switch_s)
        self._source.close()
        if self._closure is not None:
            self._closure.close()
