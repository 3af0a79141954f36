"""A device that tells finished poses, kept open: one thread reads it, and opens it again when it is gone."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Protocol

import numpy as np

from trainer.config import ConfigError
from trainer.drivers.live import Reading
from trainer.drivers.serial_port import DeviceError

#: Five frames of a tracker of 20 Hz, assumed.
STALE_S = 0.25
RETRY_S = 0.5
#: How long a thread inside of a maker's library is waited for at the end. Assumed.
LEAVE_S = 2.0


class Connection(Protocol):
    """An open device."""

    def read(self) -> Sequence[Reading]:
        """What is new, after 50 ms at most. Raises DeviceError when the device is gone."""
        ...

    def close(self) -> None: ...


def flawed(name: str, arrived_s: float, flaw: str) -> Reading:
    """A reading that holds no pose, and why."""
    return Reading(name, arrived_s, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), flaw=flaw)


class Connected:
    """The source of readings that ``connect`` opens; raises what it raises, ConfigError or DeviceError."""

    stale_s = STALE_S

    def __init__(self, name: str, connect: Callable[[], Connection]) -> None:
        self._name = name
        self._connect = connect
        self.newest: dict[str, Reading] = {}  # written by the thread that reads
        self._flaw: dict[str, str] = {}  # of the last reading; written by the same thread
        self._counts: Counter[str] = Counter()
        self._trouble = ""  # why nothing comes now
        self._reconnects = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._keep, args=(connect(),), name=name, daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """What was said before the session is no longer fresh when it begins."""

    def silence(self, sensor: str) -> str:
        return self._trouble or self._flaw.get(sensor) or f"nothing comes of '{sensor}'"

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
            self.newest[reading.name] = reading

    def summary(self) -> dict[str, object]:
        return {
            "driver": self._name,
            "readings": dict(sorted(self._counts.items())),
            "reconnects": self._reconnects,
        }

    def close(self) -> None:
        self._stop.set()
        self._thread.join(LEAVE_S)
