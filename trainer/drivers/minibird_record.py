"""Records of a miniBIRD: bytes in, samples out. Nothing here reads a port or a clock.

A record is a run of 14-bit words, each in two bytes of 7 bits, the low ones first; only the first byte of a record
has its bit 7 set (Ascension, Flock of Birds Installation and Operation Guide, Rev B, "data formats"). There is no
checksum, no sequence number and no time stamp. What guards a sample is all that such a stream offers:

* a byte with bit 7 begins a record, wherever it comes; an unfinished one is dropped;
* a record has its length, and in group mode ends with an address of the flock;
* the quaternion has length 1, as far as 14 bits can say it;
* position and orientation are near those of the last sample of that bird, or of the last two that agree;
* in group mode the birds report in a fixed order, so one out of turn tells of lost bytes;
* the first record after bytes were dropped is never trusted.

A sample that breaks a rule is handed on with the rule as its ``flaw``; it must not move anything.
"""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass, field

Numbers3 = tuple[float, float, float]
Numbers4 = tuple[float, float, float, float]

#: Words of a POSITION/QUATERNION record: x y z, q0 q1 q2 q3.
WORDS = 7
#: mm of one unit of a position word at a full scale of 36 inches.
POSITION_MM = 36.0 * 25.4 / 32768.0

#: What bytes that belong to no record are counted as.
DROPPED = "dropped bytes"
# Why a sample is not to be trusted.
RESYNC = "first after dropped bytes"
ADDRESS = "unknown address"
NORM = "quaternion not of length 1"
TURN = "out of turn"
JUMP = "leap"
MIRROR = "other hemisphere"


@dataclass(frozen=True)
class Gates:
    """What a sample of a bird in a hand can be."""

    norm: float = 0.004  # of |q|² from 1; what the tracker's 14-bit words leave it
    jump_mm: float = 60.0  # between samples: 6 m/s at 100 Hz, assumed beyond any hand
    turn_deg: float = 30.0  # between samples: 3000 °/s at 100 Hz, assumed beyond any hand


@dataclass(frozen=True, slots=True)
class Sample:
    """One record as the transmitter's frame has it."""

    address: int
    position: Numbers3  # mm
    quaternion: Numbers4  # wxyz, of length 1; the identity where ``flaw`` says that it had none
    sent_s: float  # when its first byte began its way, on the clock of ``feed``
    arrived_s: float  # when its last byte was read, on that clock
    flaw: str  # "" where nothing is wrong


def decode(record: bytes) -> list[int]:
    """The signed 16-bit words of a record (two bytes each, no address), the two lowest bits 0."""
    words = []
    for k in range(0, len(record) - 1, 2):
        word = (record[k + 1] & 0x7F) << 9 | (record[k] & 0x7F) << 2
        words.append(word - 0x10000 if word & 0x8000 else word)
    return words


def encode(words: list[int]) -> bytes:
    """The bytes of a record of 16-bit words; their two lowest bits are cut off."""
    out = bytearray()
    for word in words:
        out += bytes(((word >> 2) & 0x7F, (word >> 9) & 0x7F))
    out[0] |= 0x80
    return bytes(out)


@dataclass
class _Bird:
    """What the last samples of one bird say about the next."""

    trusted: Sample | None = None
    suspect: Sample | None = None  # the last that was plausible by itself but not beside ``trusted``
    mirrored: bool = False  # the suspect was where the trusted one would be with its position's sign changed


@dataclass
class RecordParser:
    """POSITION/QUATERNION records of one port.

    ``addresses`` are the birds on it in the order in which they report; with ``group`` each record ends with its
    bird's address, without it all records are those of the one bird. ``byte_s`` is the time of a byte on the line.
    """

    addresses: tuple[int, ...]
    group: bool
    byte_s: float
    gates: Gates = Gates()
    counts: Counter[str] = field(default_factory=Counter)  # samples by flaw, "good", and "dropped bytes"
    _record: bytearray = field(default_factory=bytearray)
    _sent_s: float = 0.0
    _dropped: bool = False  # since the last complete record
    _birds: dict[int, _Bird] = field(default_factory=dict)
    _before: int | None = None  # the address before
    _follower: dict[int, int] = field(default_factory=dict)
    _deviant: dict[int, int] = field(default_factory=dict)  # who followed instead, last time

    def __post_init__(self) -> None:
        if not self.addresses or (not self.group and len(self.addresses) != 1):
            raise ValueError("a port without group mode has one bird")
        self._length = 2 * WORDS + self.group
        self._birds = {address: _Bird() for address in self.addresses}

    def begin(self) -> None:
        """A stream begins: what was half read before it is forgotten, where the birds were is not."""
        self._drop(len(self._record))
        self._record = bytearray()
        self._dropped = False
        self._before = None

    def feed(self, data: bytes, time_s: float) -> list[Sample]:
        """The samples that ``data``, read at ``time_s`` (s, any clock), completes. Never raises."""
        out = []
        for k, byte in enumerate(data):
            if byte & 0x80:
                self._drop(len(self._record))
                self._record = bytearray((byte,))
                self._sent_s = time_s - (len(data) - k) * self.byte_s
            elif self._record:
                self._record.append(byte)
            else:
                self._drop(1)
            if len(self._record) == self._length:
                out.append(self._sample(bytes(self._record), time_s))
                self._record = bytearray()
        return out

    def _drop(self, count: int) -> None:
        if count:
            self.counts[DROPPED] += count
            self._dropped = True

    def _sample(self, record: bytes, time_s: float) -> Sample:
        address = record[-1] if self.group else self.addresses[0]
        words = decode(record[: 2 * WORDS])
        x, y, z = (POSITION_MM * w for w in words[:3])
        q = [w / 32768.0 for w in words[3:]]
        square = math.fsum(c * c for c in q)
        whole = abs(square - 1.0) <= self.gates.norm
        size = math.sqrt(square) if whole else 1.0
        quaternion = (q[0] / size, q[1] / size, q[2] / size, q[3] / size) if whole else (1.0, 0.0, 0.0, 0.0)
        sample = Sample(address, (x, y, z), quaternion, self._sent_s, time_s, "")
        flaw = self._flaw(sample, whole)
        self.counts[flaw or "good"] += 1
        return Sample(address, (x, y, z), quaternion, self._sent_s, time_s, flaw) if flaw else sample

    def _flaw(self, sample: Sample, whole: bool) -> str:
        resync, self._dropped = self._dropped, False
        if sample.address not in self._birds:
            self._dropped = True  # what it was is not known, so neither is where the next one begins
            return ADDRESS
        in_turn = self._in_turn(sample.address)
        if not whole:
            return NORM
        bird = self._birds[sample.address]
        if resync or not in_turn:
            bird.suspect, bird.mirrored = sample, self._mirrored(sample, bird.trusted)
            return RESYNC if resync else TURN
        return self._leap(bird, sample)

    def _in_turn(self, address: int) -> bool:
        """Whether ``address`` follows the one before as it did before; a new order is believed when seen twice."""
        before, self._before = self._before, address
        if before is None:
            return True
        if address in (self._follower.setdefault(before, address), self._deviant.get(before)):
            self._follower[before] = address
            self._deviant.pop(before, None)
            return True
        self._deviant[before] = address
        return False

    def _leap(self, bird: _Bird, sample: Sample) -> str:
        trusted, suspect = bird.trusted, bird.suspect
        if (trusted is None and suspect is None) or (trusted is not None and self._near(sample, trusted)):
            bird.trusted, bird.suspect = sample, None
            return ""
        if suspect is not None and self._near(sample, suspect):
            if bird.mirrored:
                bird.suspect = sample
                return MIRROR
            bird.trusted, bird.suspect = sample, None
            return ""
        if suspect is not None and bird.mirrored and self._near(sample, suspect, -1.0):
            bird.trusted, bird.suspect = sample, None
            return ""
        bird.suspect, bird.mirrored = sample, self._mirrored(sample, trusted)
        return MIRROR if bird.mirrored else JUMP

    def _mirrored(self, sample: Sample, trusted: Sample | None) -> bool:
        return trusted is not None and not self._near(sample, trusted) and self._near(sample, trusted, -1.0)

    def _near(self, a: Sample, b: Sample, sign: float = 1.0) -> bool:
        """Whether a hand can have come from ``b`` to ``a`` between two records; ``sign`` -1: mirrored in position."""
        way = math.dist(a.position, [sign * v for v in b.position])
        cosine = abs(math.fsum(p * q for p, q in zip(a.quaternion, b.quaternion, strict=True)))
        return way <= self.gates.jump_mm and cosine >= math.cos(math.radians(0.5 * self.gates.turn_deg))
