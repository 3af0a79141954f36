"""A live device looked at outside of a session: what its birds and its closure sensor said lately."""

from __future__ import annotations

import time
from collections import deque
from contextlib import ExitStack, closing
from types import TracebackType

import numpy as np

from trainer.calibration import CalibrationError
from trainer.config import ConfigError
from trainer.drivers.closure import ClosureSensor
from trainer.drivers.minibird_flock import UNHURRIED
from trainer.drivers.minibird_record import Sample
from trainer.drivers.minibird_stream import FlockStream
from trainer.drivers.monitor import Arrival, Seen, arrival, seen
from trainer.geometry import Array, quaternion_conjugate
from trainer.profile import Profile

#: A touch is the mean of what a sensor says for so long, s, while it does not leave its mean by more than …, mm.
#: Assumed: a hand on a phantom is not stiller, and a tracker's noise is a tenth of it.
STILL_S = 1.0
STILL_MM = 1.5
FEWEST = 20  # samples of a touch
#: A shorter silence is a record on its way: ten periods, assumed.
SILENT_S = 0.1


class Watch:
    """The samples of the last ``keep_s`` seconds of a profile's birds, flawed ones too."""

    def __init__(self, profile: Profile, keep_s: float) -> None:
        """Connects, configures and begins the stream. Raises ConfigError for another driver, DeviceError."""
        spec = profile.minibird
        if profile.driver != "minibird" or spec is None:
            raise ConfigError(f"device '{profile.name}' cannot be read now, only miniBIRDs can; give files of readings")
        self._spec = spec
        self._keep_s = keep_s
        self._samples: dict[int, deque[Sample]] = {bird.address: deque() for bird in spec.bird}
        with ExitStack() as opened:
            self._closure = (
                opened.enter_context(closing(ClosureSensor(profile.closure))) if profile.closure is not None else None
            )
            self._stream = opened.enter_context(closing(FlockStream(spec, self._take, UNHURRIED)))
            if self._closure is not None:
                self._closure.wait()
            self._stream.start()
            self._begun_s = time.monotonic()
            self._opened = opened.pop_all()

    def __enter__(self) -> Watch:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._opened.close()

    def _take(self, sample: Sample) -> None:
        """A sample, on the thread that read it."""
        kept = self._samples.get(sample.address)
        if kept is None:
            return
        kept.append(sample)
        while sample.arrived_s - kept[0].arrived_s > self._keep_s:
            kept.popleft()

    def samples(self, address: int) -> list[Sample]:
        """A copy; the thread that reads goes on."""
        since = time.monotonic() - self._keep_s
        return [sample for sample in self._samples[address].copy() if sample.arrived_s >= since]

    @property
    def trouble(self) -> str:
        """Why nothing comes now, or ""."""
        return self._stream.trouble

    @property
    def flaws(self) -> dict[str, int]:
        """Records since the beginning, by flaw."""
        return dict(sorted(self._stream.counts.items()))

    def arrival(self) -> Arrival:
        """Of the first bird's records; lost are those that are missing of the rate that was asked for."""
        return self._arrival(self.samples(self._spec.bird[0].address))

    def _arrival(self, kept: list[Sample]) -> Arrival:
        now = time.monotonic()
        begun = max(self._begun_s, now - self._keep_s)
        arrived = np.array([sample.arrived_s for sample in kept])
        first, last = (arrived[0], arrived[-1]) if kept else (now, begun)
        span = (begun if first - begun > SILENT_S else first, now if now - last > SILENT_S else last)
        return arrival(arrived, nominal_hz=self._spec.rate_hz, span=span)

    def seen(self) -> dict[str, tuple[str, Seen]]:
        """By sensor (bird1 …): its tool, and what it said; ``ok`` are the samples without flaw."""
        now = time.monotonic()
        found: dict[str, tuple[str, Seen]] = {}
        for bird in self._spec.bird:
            kept = self.samples(bird.address)
            position = np.array([sample.position for sample in kept]).reshape(-1, 3)
            closure: Array | None = None
            if self._closure is not None and self._closure.has(bird.tool):
                share, trouble = self._closure.closure(bird.tool, now)
                closure = None if trouble else np.array([share])
            ok = np.array([not sample.flaw for sample in kept], dtype=bool)
            found[bird.name] = (bird.tool, seen(position, ok, closure, self._arrival(kept).lost or 0))
        return found

    def poses(self, address: int, seconds: float) -> tuple[Array, Array]:
        """Position (n, 3) mm and quaternion (n, 4) transmitter_from_sensor of the next so many seconds' good samples.

        Raises CalibrationError where hardly any come.
        """
        begun = time.monotonic()
        time.sleep(seconds)
        good = [s for s in self.samples(address) if not s.flaw and s.arrived_s >= begun]
        if len(good) < FEWEST:
            raise CalibrationError(f"bird {address}: {self.trouble or 'hardly any good sample comes'}")
        quaternion: Array = np.array([s.quaternion for s in good])
        if self._stream.inverse[address]:
            quaternion = quaternion_conjugate(quaternion)
        return np.array([s.position for s in good]), quaternion

    def touch(self, address: int) -> tuple[Array, Array]:
        """Mean position (3,) and quaternion (4,) of a sensor that is held still. Raises CalibrationError."""
        position, quaternion = self.poses(address, STILL_S)
        mean = position.mean(axis=0)
        strayed = float(np.linalg.norm(position - mean, axis=1).max())
        if strayed > STILL_MM:
            raise CalibrationError(f"the sensor moved by {strayed:.1f} mm; hold it still for {STILL_S:g} s")
        turn = (np.sign(quaternion @ quaternion[0])[:, None] * quaternion).sum(axis=0)
        return mean, turn / np.linalg.norm(turn)
