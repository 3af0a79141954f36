"""The stream of a flock, kept going: one thread reads each port, one sees to it that there is something to read.

When birds fall silent or a port goes, the ports are closed, opened, the flock configured and the stream begun again,
for as long as it takes. Nothing of it reaches the session but silence and its reason.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from trainer.drivers.minibird_flock import UNHURRIED, Flock, Silences
from trainer.drivers.minibird_record import MIRROR, RecordParser, Sample
from trainer.drivers.serial_port import DeviceError, read_some
from trainer.profile import MinibirdSpec

#: A bird of which nothing believable comes for this long has lost its stream: 50 records in a row, assumed.
SILENT_S = 0.5
RETRY_S = 0.5
GONE = "the port is gone"


class _Ended(Exception):
    """The session has ended while the flock was waited for."""


class FlockStream:
    """Samples of a profile's birds, flawed ones too, given to ``take`` in the order in which they came.

    ``take`` is called by the threads that read: at once, and never for two birds of one port at the same time.
    """

    def __init__(self, spec: MinibirdSpec, take: Callable[[Sample], None], silences: Silences = UNHURRIED) -> None:
        """Configures the flock. Raises DeviceError."""
        self._addresses = tuple(bird.address for bird in spec.bird)
        self._take = take
        self._stop = threading.Event()
        self._failed = threading.Event()
        self._flock = Flock(spec, silences, self._pause)
        self._heard_s: dict[int, float] = {}  # when a bird last said something believable
        self._unheard: set[int] = set()  # birds of which nothing has come since the stream began
        self._keeper: threading.Thread | None = None
        self.trouble = ""  # why nothing comes now
        self.restarts = 0
        self._flock.connect()

    @property
    def inverse(self) -> dict[int, bool]:
        """Birds whose quaternions are those of the inverse rotation."""
        return self._flock.inverse

    @property
    def counts(self) -> Counter[str]:
        """Samples by flaw, "good" ones and "dropped bytes", of the whole session."""
        return sum((parser.counts.copy() for parser in self._flock.parsers.values()), Counter())

    def start(self) -> None:
        self._keeper = threading.Thread(target=self._keep, name="flock", daemon=True)
        self._keeper.start()

    def close(self) -> None:
        """End the stream and give the ports back."""
        self._stop.set()
        if self._keeper is not None:
            self._keeper.join()
        self._flock.disconnect()

    def _pause(self, seconds: float) -> None:
        if self._stop.wait(seconds):
            raise _Ended

    def _keep(self) -> None:
        try:
            while True:
                self._stream()
                self._flock.disconnect()
                self._connect_again()
        except _Ended:
            return

    def _connect_again(self) -> None:
        while True:
            self._pause(RETRY_S)
            try:
                self._flock.connect()
            except DeviceError as error:
                self.trouble = str(error)
            else:
                self.restarts += 1
                return

    def _stream(self) -> None:
        """Until something is wrong or the session ends."""
        try:
            lines = self._flock.begin()
        except OSError:
            self.trouble = GONE
            return
        self._failed.clear()
        self._heard_s = dict.fromkeys(self._addresses, time.monotonic())
        self._unheard = set(self._addresses)
        readers = [threading.Thread(target=self._read, args=line, name="bird", daemon=True) for line in lines.values()]
        for reader in readers:
            reader.start()
        while not (self._failed.wait(0.1 * SILENT_S) or self._stop.is_set()):
            silent = [a for a, heard_s in self._heard_s.items() if time.monotonic() - heard_s > SILENT_S]
            if silent:
                self.trouble = f"bird {silent[0]} is silent"
                self._failed.set()
        self._failed.set()
        for reader in readers:
            reader.join()
        if self._stop.is_set():
            raise _Ended

    def _read(self, port: Any, parser: RecordParser) -> None:
        while not self._failed.is_set():
            try:
                data = read_some(port)
            except OSError:
                self.trouble = GONE
                self._failed.set()
                return
            for sample in parser.feed(data, time.monotonic()) if data else ():
                if sample.address in self._heard_s:
                    if sample.flaw in ("", MIRROR):
                        self._heard_s[sample.address] = sample.arrived_s
                        self._welcome(sample.address)
                    self._take(sample)

    def _welcome(self, address: int) -> None:
        """A bird is back. The trouble is over with the last one, once: that of a bird falling silent comes later."""
        if address in self._unheard:
            self._unheard.discard(address)
            if not self._unheard:
                self.trouble = ""
