"""A device that tells poses is opened again whatever opening it says, until it is there."""

from __future__ import annotations

import threading
import time
from functools import partial

import numpy as np
from live_polling import HOME, TICK_HZ, TOOLS, Polling
from waiting import PATIENCE_S

from trainer.config import ConfigError
from trainer.drivers.connected import Connected, Connection
from trainer.drivers.live import LivePoses, Reading
from trainer.drivers.serial_port import DeviceError
from trainer.profile import Registration, Tracked


class Flaky:
    """A device that is there, or is gone at once."""

    def __init__(self, gone: bool) -> None:
        self._gone = gone

    def read(self) -> list[Reading]:
        time.sleep(0.005)
        if self._gone:
            raise DeviceError("gone")
        return [Reading("sensor", time.monotonic(), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))]

    def close(self) -> None:
        """There is nothing to give back."""


def test_a_file_that_is_missing_for_a_while_does_not_end_the_reconnecting() -> None:
    tries, known = 0, threading.Event()

    def connect() -> Connection:
        nonlocal tries
        tries += 1
        if tries == 2:
            raise ConfigError("tool.rom: no such ROM file")
        assert tries == 1 or known.wait(PATIENCE_S)
        return Flaky(gone=tries == 1)

    sensor = Tracked(name="sensor", tool="left")
    driver = LivePoses(partial(Connected, "ndi", connect), Registration(), (sensor,), None, TOOLS, TICK_HZ, HOME)
    polling = Polling(driver)
    polling.until(lambda poses: "no such ROM file" in polling.reasons())
    known.set()
    polling.until(lambda poses: driver.summary()["reconnects"] == 1)
    driver.close()
    assert tries == 3
