"""miniBIRDs and a closure sensor as the instruments of a session."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from trainer.drivers.clock_line import ClockLine
from trainer.drivers.live import LivePoses, Reading
from trainer.drivers.minibird_flock import UNHURRIED, Silences
from trainer.drivers.minibird_record import Sample
from trainer.drivers.minibird_stream import FlockStream
from trainer.geometry import quaternion_conjugate
from trainer.poses import ToolPoses
from trainer.profile import ClosureSpec, MinibirdSpec

#: Ten records in a row, assumed.
STALE_S = 0.1


class Birds:
    """The source of a flock's readings; ``line`` follows the clock of its first bird."""

    stale_s = STALE_S

    def __init__(self, spec: MinibirdSpec, line: ClockLine, silences: Silences) -> None:
        """Connects and configures; the stream begins with the session. Raises DeviceError."""
        self._names = {bird.address: bird.name for bird in spec.bird}
        self._first = spec.bird[0].address
        self._line = line
        self.newest: dict[str, Reading] = {}  # written by the threads that read
        self._flaw: dict[str, str] = {}  # of the last sample; written by the same threads
        self._stream = FlockStream(spec, self._take, silences)

    def begin(self) -> None:
        self._stream.start()

    def _take(self, sample: Sample) -> None:
        """A sample, on the thread that read it."""
        name = self._names[sample.address]
        self._flaw[name] = sample.flaw
        if sample.flaw:
            return
        turn = np.array(sample.quaternion)
        if self._stream.inverse[sample.address]:
            turn = quaternion_conjugate(turn)
        on_the_way_s = sample.arrived_s - sample.sent_s
        self.newest[name] = Reading(name, sample.arrived_s, np.array(sample.position), turn, on_the_way_s=on_the_way_s)
        if sample.address == self._first:
            self._line.observe(sample.sent_s)

    def silence(self, sensor: str) -> str:
        if sensor not in self.newest:
            return self._stream.trouble or "the stream does not start"
        return self._stream.trouble or self._flaw[sensor] or "no sample comes"

    def summary(self) -> dict[str, object]:
        jitter_s = self._line.jitter_s
        return {
            "driver": "minibird",
            "records": dict(sorted(self._stream.counts.items())),
            "measured_rate_hz": round(self._line.rate_hz, 3),
            "jitter_ms": None if jitter_s is None else round(1e3 * jitter_s, 3),
            "restarts": self._stream.restarts,
        }

    def close(self) -> None:
        self._stream.close()


class Minibird(LivePoses):
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
        """Raises ConfigError, DeviceError."""
        self._rate_hz = spec.rate_hz
        self._line = ClockLine(1.0 / spec.rate_hz)
        super().__init__(partial(Birds, spec, self._line, silences), spec, spec.bird, closure, tools, tick_hz, home)

    def apart_ticks(self) -> tuple[float, int]:
        """The session's clock when this tick began less the device's, in ticks, and which of its beginnings it is.

        The device's clock counts its samples, lost ones too, at the rate that was asked for; it begins with the stream,
        and anew after a pause. How far both come apart later is drift; a tick that begins late is not.
        """
        samples, begun = self._line.read(self._polled_s)
        return self._tick - samples / self._rate_hz / self._pace.tick_s, begun
