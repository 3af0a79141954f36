"""A serial line on a pseudo-terminal: bytes leave at the pace of the baud rate, whole or spoilt."""

from __future__ import annotations

import os
import termios
import tty
from collections import deque
from pathlib import Path

import numpy as np

from trainer.simulators.faults import Faults

FIFO = 16  # bytes that a common UART (16550A) collects
PACKET = 64  # bytes of a USB packet
CHUNKS = (1, 7, 16, 62)
BUNCH_S = 0.016  # the latency timer of a common USB adapter
#: A device that says more than its line can carry is cut off at so many writes, …
MOST_WAITING = 20_000
#: … and a host that does not read loses what goes beyond the terminal's own 20 kB by so many bytes (at real speed).
MOST_LATE = 64_000


class Line:
    """One port. ``speed`` is how many times faster than real time everything runs.

    ``piece`` is how many bytes the host's end of the line hands over together at the most, and
    ``link`` is the stable path at which hosts find the port, also after it was unplugged.
    """

    def __init__(
        self, link: Path, baud: int, speed: float, faults: Faults, rng: np.random.Generator, piece: int
    ) -> None:
        self._link = link
        self._baud = baud
        self._byte_s = 10.0 / (baud * speed)
        self._bunch_s = BUNCH_S / speed
        self._most_late = int(MOST_LATE * speed)
        self._faults = faults
        self._rng = rng
        self._piece = piece
        self._waiting: deque[tuple[float, bytes]] = deque()  # when the last byte of each piece is out
        self._late = bytearray()  # what was due when the terminal was full
        self._free_s = 0.0  # when the line has sent what it was given
        self._master = self._slave = -1
        self.plug()

    @property
    def plugged(self) -> bool:
        return self._master >= 0

    def fileno(self) -> int:
        return self._master

    def plug(self) -> None:
        """Appear at the link. The slave stays open here, so that a host may come and go."""
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)  # before a host has opened it, it would echo
        os.set_blocking(self._master, False)
        fresh = self._link.with_name(self._link.name + ".new")
        fresh.unlink(missing_ok=True)
        fresh.symlink_to(os.ttyname(self._slave))
        fresh.replace(self._link)

    def unplug(self) -> None:
        self._link.unlink(missing_ok=True)
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1
        self._waiting.clear()
        self._late.clear()

    def read(self) -> bytes:
        """What the host has written; noise where its baud rate is another."""
        try:
            data = os.read(self._master, 4096)
        except OSError:
            return b""
        return data if self._same_baud() else self._noise(len(data))

    def send(self, data: bytes, now_s: float) -> None:
        """Queue ``data``, which the device begins to send at ``now_s``."""
        if not self.plugged or len(self._waiting) > MOST_WAITING:
            return
        begun = max(self._free_s, now_s)
        self._free_s = begun + len(data) * self._byte_s
        data = self._faults.spoil(data, self._rng)
        if not self._same_baud():
            data = self._noise(len(data))
        start = 0
        while start < len(data):
            size = int(self._rng.choice(CHUNKS)) if self._faults.split else self._piece
            end = min(start + size, len(data))
            due = begun + end * self._byte_s
            if self._faults.bunch:
                due = (due // self._bunch_s + 1.0) * self._bunch_s
            self._waiting.append((due, data[start:end]))
            start = end

    def pump(self, now_s: float) -> None:
        """Hand over what is due; a host that takes nothing for long loses what no longer fits."""
        while self._waiting and self._waiting[0][0] <= now_s and self.plugged:
            self._late += self._waiting.popleft()[1]
        if self._late and self.plugged:
            try:
                taken = os.write(self._master, self._late)
            except OSError:
                taken = 0
            del self._late[:taken]
            del self._late[self._most_late :]

    def next_s(self) -> float:
        """When the next bytes are due; infinity where none wait."""
        return self._waiting[0][0] if self._waiting else float("inf")

    def _same_baud(self) -> bool:
        """A pseudo-terminal carries bytes at any rate, but it knows what the host asked for."""
        wanted = getattr(termios, f"B{self._baud}", None)
        asked = termios.tcgetattr(self._slave)[5]
        return wanted is None or asked in (wanted, termios.B38400)  # 38400: no host has set it yet

    def _noise(self, count: int) -> bytes:
        return self._rng.integers(0, 256, count, dtype=np.uint8).tobytes()
