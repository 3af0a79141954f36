"""OpenIGTLink messages as bytes: TRANSFORM written and read, all others passed by.

A message is a header of 58 bytes, big-endian, and a body: version, type (12 characters), device name (20), time stamp
in s and 2⁻³² s, the body's length and its checksum (CRC-64/ECMA-182). The body of a TRANSFORM is twelve float32, the
rotation's columns and then the translation in mm. From version 2 of the header on, that content stands between an
extended header, which tells its own length and that of the metadata, and the metadata. Protocol: openigtlink.org,
"OpenIGTLink Protocol V2" and "V3"; the checksum's polynomial: ECMA-182.
"""

from __future__ import annotations

import struct
from collections import Counter
from dataclasses import dataclass

import numpy as np

from trainer.geometry import Array

HEADER = struct.Struct(">H12s20sIIQQ")
CONTENT = struct.Struct(">12f")
EXTENDED = struct.Struct(">HHII")  # its own length, that of the metadata's header, of the metadata, a number
#: Bodies beyond this, bytes, are no message's: a picture of 1 GiB, assumed. Only a TRANSFORM's is kept.
LONGEST = 2**30
LONGEST_TRANSFORM = 2**16
POLYNOMIAL = 0x42F0E1EBA9EA3693


def _table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 56
        for _ in range(8):
            crc = ((crc << 1) ^ (POLYNOMIAL if crc >> 63 else 0)) & (2**64 - 1)
        table.append(crc)
    return tuple(table)


_TABLE = _table()


def crc64(data: bytes) -> int:
    """The checksum of a body."""
    crc = 0
    for byte in data:
        crc = (crc << 8) & (2**64 - 1) ^ _TABLE[crc >> 56 ^ byte]
    return crc


@dataclass(frozen=True)
class Transform:
    """A device's pose as a message tells it."""

    device: str
    position: Array  # (3,) mm
    rotation: Array  # (3, 3); what the sender wrote, a rotation or not
    stamp_s: float  # by the sender's clock


def encode(transform: Transform) -> bytes:
    """A TRANSFORM message, header version 1. Raises ValueError for a name that is longer than 20 bytes."""
    name = transform.device.encode()
    if len(name) > 20:
        raise ValueError(f"a device name of OpenIGTLink has at most 20 bytes, '{transform.device}' has {len(name)}")
    body = CONTENT.pack(*transform.rotation.T.ravel(), *transform.position)
    seconds = int(transform.stamp_s)
    fraction = int((transform.stamp_s - seconds) * 2**32)
    return HEADER.pack(1, b"TRANSFORM", name, seconds, fraction, len(body), crc64(body)) + body


class MessageParser:
    """Bytes, in pieces of any size, into transforms.

    TCP loses nothing, so a header that cannot be one means that the peer speaks something else: ``broken`` says so,
    and nothing more is read.
    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.broken = ""
        self._buffer = bytearray()
        self._skip = 0  # bytes of a body that nobody asked for

    def feed(self, data: bytes) -> list[Transform]:
        """The transforms that ``data`` completes."""
        found: list[Transform] = []
        if self._skip:
            passed = min(self._skip, len(data))
            self._skip -= passed
            data = data[passed:]
        self._buffer += data
        while not self.broken and len(self._buffer) >= HEADER.size:
            version, kind, device, seconds, fraction, length, crc = HEADER.unpack_from(self._buffer)
            kind = kind.rstrip(b"\0 ")
            if not 1 <= version <= 3 or not kind.isascii() or not kind or length > LONGEST:
                self.broken = "what comes is not OpenIGTLink"
            elif kind != b"TRANSFORM" or length > LONGEST_TRANSFORM:
                self.counts["other messages"] += 1
                there = min(length, len(self._buffer) - HEADER.size)
                self._skip = length - there
                del self._buffer[: HEADER.size + there]
            elif len(self._buffer) < HEADER.size + length:
                break
            else:
                body = bytes(self._buffer[HEADER.size : HEADER.size + length])
                del self._buffer[: HEADER.size + length]
                content = _content(body, version, crc)
                self.counts["damaged" if content is None else "transforms"] += 1
                if content is not None:
                    name = device.rstrip(b"\0 ").decode(errors="replace")
                    found.append(Transform(name, content[3], content[:3].T, seconds + fraction / 2**32))
        if self.broken:
            self._buffer.clear()
        return found


def _content(body: bytes, version: int, crc: int) -> Array | None:
    """The rotation's columns and the translation (4, 3) of a TRANSFORM; None where checksum or length are wrong."""
    if crc64(body) != crc:
        return None
    first, last = 0, len(body)
    if version > 1:
        if len(body) < EXTENDED.size:
            return None
        first, table, metadata, _ = EXTENDED.unpack_from(body)
        last -= table + metadata
    if last - first != CONTENT.size:
        return None
    return np.reshape(CONTENT.unpack_from(body, first), (4, 3))
