"""Instruments moved by a device that tells their poses: one thread reads it, and opens it again when it is gone."""

from __future__ import annotations

import sys
import threading
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from trainer.config import ConfigError
from trainer.drivers.closure import ClosureSensor
from trainer.drivers.in_hand import SWITCH_S, Latency, Losses, Pace, Placer
from trainer.drivers.serial_port import DeviceError
from trainer.geometry import Array
from trainer.poses import ToolPoses
from trainer.profile import ClosureSpec, Registration, Tracked

#: A reading older than this no longer says where the hand is: five frames of a tracker of 20 Hz, assumed.
STALE_S = 0.25
RETRY_S = 0.5
#: How long a thread inside of a maker's library is waited for at the end. Assumed.
LEAVE_S = 2.0


@dataclass(frozen=True)
class Reading:
    """What a device says of one of its sensors."""

    name: str
    arrived_s: float
    position: Array  # (3,) mm, device frame
    quaternion: Array  # (4,) wxyz
    closure: float | None = None  # where the device knows of jaws
    flaw: str = ""  # why this is no pose


class Connection(Protocol):
    """An open device."""

    def read(self) -> Sequence[Reading]:
        """What is new, after 50 ms at most. Raises DeviceError when the device is gone."""
        ...

    def close(self) -> None: ...


def flawed(name: str, arrived_s: float, flaw: str) -> Reading:
    """A reading that holds no pose, and why."""
    return Reading(name, arrived_s, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), flaw=flaw)


def check_tools(moved: Sequence[str], tools: Sequence[str]) -> None:
    """Raises ConfigError where a device moves none of the task's instruments."""
    if not set(moved) & set(tools):
        raise ConfigError(f"the device moves {', '.join(moved)}; the task has {', '.join(tools)}")


class LivePoses:
    """Driver of a device that ``connect`` opens; raises what it raises, ConfigError or DeviceError, at the start."""

    def __init__(
        self,
        name: str,
        connect: Callable[[], Connection],
        registration: Registration,
        sensors: Sequence[Tracked],
        closure: ClosureSpec | None,
        tools: Sequence[str],
        tick_hz: float,
        home: ToolPoses,
    ) -> None:
        self._name = name
        self._connect = connect
        check_tools([sensor.tool for sensor in sensors], tools)
        self._sensors = [(sensor, tools.index(sensor.tool)) for sensor in sensors if sensor.tool in tools]
        self._home = home
        self._position, self._quaternion = home.position.copy(), home.quaternion.copy()
        self._jaws = home.closure.copy()
        self._pace = Pace(tick_hz)
        self._placer = Placer(registration, home)
        self._latency = Latency()
        self._losses = Losses(self._pace.tick_s)
        self._counts: Counter[str] = Counter()
        self._newest: dict[str, Reading] = {}  # the last without flaw; written by the thread that reads
        self._flaw: dict[str, str] = {}  # of the last reading; written by the same thread
        self._used: dict[str, Reading] = {}
        self._trouble = ""  # why nothing comes now
        self._reconnects = 0
        self._stop = threading.Event()
        with ExitStack() as opened:
            self._closure = opened.enter_context(closing(ClosureSensor(closure))) if closure is not None else None
            if self._closure is not None:
                self._closure.wait()
            connection = connect()
            opened.pop_all()
        self._thread = threading.Thread(target=self._keep, args=(connection,), name=name, daemon=True)
        self._switch_s = sys.getswitchinterval()
        sys.setswitchinterval(SWITCH_S)
        self._thread.start()

    def _keep(self, connection: Connection | None) -> None:
        """Read until the session ends; a device that is gone is opened again, for as long as it takes."""
        while not self._stop.is_set():
            try:
                if connection is None:
                    connection = self._connect()
                    self._reconnects += 1
                    self._trouble = ""
                for reading in connection.read():
                    self._take(reading)
            except (DeviceError, ConfigError) as error:  # a file that the profile names may be gone as well
                self._trouble = str(error)
                if connection is not None:
                    connection.close()
                    connection = None
                self._stop.wait(RETRY_S)
        if connection is not None:
            connection.close()

    def _take(self, reading: Reading) -> None:
        self._counts[reading.flaw or "good"] += 1
        self._flaw[reading.name] = reading.flaw
        if not reading.flaw:
            self._newest[reading.name] = reading

    def poll(self, tick: int, view: object) -> ToolPoses | None:
        """The newest poses. Where nobody else paces the session, waits until the tick is due."""
        now = self._pace.wait(tick)
        self._latency.begin()
        valid = np.asarray(self._home.valid, dtype=bool).copy()
        reasons = [""] * len(valid)
        for sensor, k in self._sensors:
            reasons[k] = reason = self._follow(sensor, k, now)
            valid[k] = not reason
            self._losses.note(sensor.tool, tick, reason)
        return ToolPoses(self._position.copy(), self._quaternion.copy(), self._jaws.copy(), valid, tuple(reasons))

    def _follow(self, sensor: Tracked, k: int, now: float) -> str:
        """Bring an instrument to where its sensor is; "" or why that is not known."""
        reading = self._newest.get(sensor.name)
        if reading is None or now - reading.arrived_s > STALE_S:
            if reading is None and self._pace.starting(now):
                return ""
            return self._trouble or self._flaw.get(sensor.name) or f"nothing comes of '{sensor.name}'"
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
            self._latency.used(reading.arrived_s)
        self._jaws[k] = jaws
        return ""

    def tick(self, record: object) -> None:
        """The events of a tick are with the sinks: how long did its poses take to become them?"""
        self._latency.told()

    def summary(self) -> dict[str, object]:
        """What was read, how late, and when and why it was not."""
        return {
            "driver": self._name,
            "readings": dict(sorted(self._counts.items())),
            "latency_ms": self._latency.summary(),
            "reconnects": self._reconnects,
            **self._losses.summary(),
            "closure": None if self._closure is None else self._closure.summary(),
        }

    def close(self) -> None:
        sys.setswitchinterval(self._switch_s)
        self._stop.set()
        self._thread.join(LEAVE_S)
        if self._closure is not None:
            self._closure.close()
