"""A station of simulated devices in one process: lines, flock and closure board, driven by one loop."""

from __future__ import annotations

import math
import select
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from trainer.config import ConfigError
from trainer.geometry import Rigid
from trainer.profile import ClosureSpec, MinibirdSpec
from trainer.simulators.closure_board import BOOT, RATE_HZ, ClosureBoard
from trainer.simulators.faults import Faults
from trainer.simulators.flock import SILENCE_S, Flock
from trainer.simulators.hands import Hands
from trainer.simulators.line import FIFO, PACKET, Line

GARBAGE = 30  # bytes that a device of no known kind says in each cycle
LATE_S = 0.1  # a process that slept longer leaves out what it would have measured
IDLE_S = 0.05  # the longest sleep, so that an end that is asked for comes soon


class Station:
    """``ports`` are the paths of the lines: of the flock (or of each bird), then of the closure board."""

    def __init__(
        self,
        spec: MinibirdSpec,
        closure: ClosureSpec | None,
        hands: Hands,
        ports: list[Path],
        speed: float,
        faults: Faults,
        closure_faults: Faults,
        seed: int,
    ) -> None:
        """Raises ConfigError where the missing bird is none of them, or the only one."""
        self._hands, self._speed, self._faults, self._closure_faults = hands, speed, faults, closure_faults
        self._rng = np.random.default_rng(seed)
        self._birds = {address: k for k, address in enumerate(hands.addresses)}
        self._tools = {bird.address: bird.tool for bird in spec.bird}
        present = [a for a in self._birds if a != faults.no_bird]
        if not present or faults.no_bird not in (0, *self._birds):
            raise ConfigError(f"--fault no-bird={faults.no_bird}: one of {len(self._birds)}, and another must be there")
        self._flock = Flock(present, self._pose, SILENCE_S / speed)
        own = [bird.address for bird in spec.bird] if not spec.port else [min(self._birds)]
        self._lines = {
            address: Line(path, spec.baud, speed, faults, self._rng, FIFO)
            for address, path in zip(own, ports, strict=False)
        }
        self._board = ClosureBoard(closure) if closure is not None else None
        self._closure_line = (
            Line(ports[-1], closure.baud, speed, closure_faults, self._rng, PACKET) if closure is not None else None
        )
        self._closure_s = 0.0 if closure is not None else math.inf  # when the next line is due
        self._begun_s: float | None = None  # when the first stream was asked for: motion begins
        self._cycle_s = 0.0  # when the next measurement cycle ends
        self._sample = 0  # of a motion that is sampled by itself
        self._powered = True

    def run(self, ended: Callable[[], bool]) -> dict[str, object]:
        """Until ``ended``; what happened, for whoever asks."""
        self._cycle_s = time.monotonic()
        while not ended():
            now = time.monotonic()
            self._happen(now)
            self._listen(now)
            self._measure(now)
            lines = self._all_lines()
            for line in lines:
                line.pump(time.monotonic())
            due = min([line.next_s() for line in lines] + [self._cycle_due(), self._closure_s, now + IDLE_S])
            plugged = [line for line in lines if line.plugged]
            select.select(plugged, [], [], max(0.0, due - time.monotonic()))
        for line in self._all_lines():
            if line.plugged:
                line.unplug()
        return {"transmitter_damaged": self._flock.damaged, "motion_s": self._motion_s(time.monotonic())}

    def _all_lines(self) -> list[Line]:
        return [*self._lines.values(), *([self._closure_line] if self._closure_line is not None else [])]

    def _motion_s(self, now: float) -> float:
        """Time in the motion: 0 until a host first asked for the stream."""
        return 0.0 if self._begun_s is None else (now - self._begun_s) * self._speed

    def _pose(self, address: int) -> Rigid:
        if self._hands.sampled:
            time_s = float(self._hands.time[min(self._sample, len(self._hands.time) - 1)])
        else:
            time_s = self._motion_s(time.monotonic())
        return self._hands.at(time_s, self._birds[address])

    def _happen(self, now: float) -> None:
        """What the faults have happen at this time of the motion."""
        t = self._motion_s(now) if self._begun_s is not None else -1.0
        for line, faults in [(line, self._faults) for line in self._lines.values()] + (
            [(self._closure_line, self._closure_faults)] if self._closure_line is not None else []
        ):
            if faults.unplug.holds(t) == line.plugged:
                if line.plugged:
                    line.unplug()
                else:
                    line.plug()
        powered = not self._faults.power_cycle.holds(t)
        if powered and not self._powered:
            self._flock.power_cycle()
        self._powered = powered
        self._flock.mirrored = self._faults.hemisphere.holds(t)

    def _listen(self, now: float) -> None:
        for address, line in self._lines.items():
            data = line.read() if line.plugged else b""
            if not data or not self._powered:
                continue
            if self._faults.garbage or address not in self._flock.units:
                continue
            line.send(self._flock.receive(address, data, now), now)
            if self._begun_s is None and any(unit.streaming for unit in self._flock.units.values()):
                self._begun_s = self._cycle_s = now
        if self._closure_line is not None and self._closure_line.plugged:
            self._closure_line.read()

    def _cycle_due(self) -> float:
        if self._hands.sampled and self._begun_s is not None:
            if self._sample >= len(self._hands.time):
                return float("inf")
            return self._begun_s + float(self._hands.time[self._sample]) / self._speed
        return self._cycle_s

    def _measure(self, now: float) -> None:
        if not self._hands.sampled and now - self._cycle_s > LATE_S:
            self._cycle_s = now
        while self._cycle_due() <= now:
            due = self._cycle_due()
            self._cycle_s = due + 1.0 / (self._flock.rate_hz * self._speed)
            if self._faults.garbage:
                for line in self._lines.values():
                    line.send(self._rng.integers(0, 256, GARBAGE, dtype=np.uint8).tobytes(), now)
            quiet = not self._powered or self._faults.mute or self._faults.pause.holds(self._motion_s(now))
            records = self._flock.cycle()
            for address, record in records.items():
                if not quiet and not self._faults.garbage and address in self._lines:
                    self._lines[address].send(record, due)
            if self._hands.sampled and self._begun_s is not None:
                self._sample += 1
        while self._closure_line is not None and self._board is not None and self._closure_s <= now:
            self._say_closure(now)

    def _say_closure(self, now: float) -> None:
        assert self._board is not None and self._closure_line is not None
        if self._closure_s == 0.0:
            self._closure_s = now
            self._closure_line.send(BOOT, now)
        t, faults = self._motion_s(now), self._closure_faults
        closure: dict[str, float] = {tool: self._hands.closure_at(t, self._birds[a]) for a, tool in self._tools.items()}
        line = self._board.line(t, closure, faults.stuck.holds(t), faults.out_of_range.holds(t))
        if not faults.pause.holds(t):
            self._closure_line.send(line, self._closure_s)
        self._closure_s += 1.0 / (RATE_HZ * self._speed)


def with_ports(text: str, ports: list[Path], in_scene: bool) -> str:
    """A profile's text with its ports replaced: those of the flock or its birds in their order, then the board's.

    Motion that is given in the scene is anchored by the profile's mapping, not by where it begins.
    """
    lines = []
    flock, table = iter(ports), ""
    for line in text.splitlines():
        key = line.partition("=")[0].strip()
        if key.startswith("["):
            table = key.partition("]")[0].strip("[ ")
        if key == "port" and table in ("minibird", "minibird.bird"):
            line = f'port = "{next(flock)}"'
        elif key == "port" and table == "closure":
            line = f'port = "{ports[-1]}"'
        elif key == "anchor" and in_scene:
            line = 'anchor = "none"'
        lines.append(line)
    return "\n".join(lines) + "\n"
