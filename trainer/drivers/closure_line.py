"""Lines of a closure sensor: bytes in, counts out. Nothing here reads a port or a clock.

A line is ``C,<seq>,<micros>,<left>,<right>*<XX>`` and a newline: sequence number and microseconds (both run over at
2³²), the raw counts of two analogue inputs, and the exclusive or of all bytes between ``C`` and ``*``, C included, in
two hexadecimal digits. What does not match is dropped up to the next newline.
"""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass, field
from functools import reduce
from operator import xor

LINE = re.compile(rb"(C,([0-9]{1,10}),([0-9]{1,10}),([0-9]{1,5}),([0-9]{1,5}))\*([0-9A-F]{2})\r?")
#: A longer run without newline is no line.
LONGEST = 64


@dataclass(frozen=True, slots=True)
class Counts:
    """One line: raw counts of both forceps."""

    seq: int
    micros: int
    left: int
    right: int
    arrived_s: float


def checksum(body: bytes) -> int:
    return reduce(xor, body, 0)


def encode(seq: int, micros: int, left: int, right: int) -> bytes:
    """The line of a sensor, with its newline."""
    body = b"C,%d,%d,%d,%d" % (seq % 2**32, micros % 2**32, left, right)
    return b"%s*%02X\n" % (body, checksum(body))


@dataclass
class LineParser:
    """Lines out of any bytes in any split."""

    counts: Counter[str] = field(default_factory=Counter)  # "good", "not a line", "checksum", "lost lines"
    _line: bytearray = field(default_factory=bytearray)
    _overlong: bool = False
    _seq: int | None = None

    def feed(self, data: bytes, time_s: float) -> list[Counts]:
        """The lines that ``data``, read at ``time_s`` (s, any clock), completes. Never raises."""
        out = []
        for part in re.findall(rb"[^\n]*\n|[^\n]+", data):
            self._line += part[: LONGEST + 1]
            self._overlong |= len(self._line) > LONGEST
            if self._overlong:
                self._line.clear()
            if part.endswith(b"\n"):
                if (found := self._whole(bytes(self._line), time_s)) is not None:
                    out.append(found)
                self._line.clear()
                self._overlong = False
        return out

    def _whole(self, line: bytes, time_s: float) -> Counts | None:
        match = LINE.fullmatch(line.rstrip(b"\n"))
        if match is None or self._overlong:
            self.counts["not a line"] += 1
            return None
        if checksum(match[1]) != int(match[6], 16):
            self.counts["checksum"] += 1
            return None
        seq, micros, left, right = (int(match[k]) for k in range(2, 6))
        if self._seq is not None:
            missed = (seq - self._seq - 1) % 2**32
            # A board that began anew counts from 0 again: nothing was lost.
            self.counts["lost lines"] += missed if missed < 1000 else 0
        self._seq = seq
        self.counts["good"] += 1
        return Counts(seq, micros, left, right, time_s)
