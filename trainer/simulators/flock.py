"""A flock of miniBIRDs as a host sees it: bytes of commands in, bytes of replies and records out.

No clock and no port: the caller says what time it is and when a measurement cycle ends. Commands, parameters, their
lengths, defaults and error codes: Ascension, Flock of Birds Installation and Operation Guide, Rev B.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np

from trainer.drivers.minibird_record import POSITION_MM, encode
from trainer.geometry import Array, Rigid

#: Argument bytes of each command; CHANGE VALUE ('P') has those of its parameter besides.
ARGUMENTS = dict.fromkeys(b"VWXYZ\\]B@?QRSTFGuvNt/\x11\x13z", 0) | {
    ord("O"): 1, ord("P"): 1, ord("L"): 2, ord("J"): 12, ord("H"): 12, ord("q"): 6, ord("r"): 6, ord("K"): 6,
    ord("M"): 1, ord("s"): 2, ord("A"): 1, ord("0"): 1,
}  # fmt: skip
#: What EXAMINE VALUE answers, where it is a stored value: parameter → its default.
DEFAULTS = {
    1: b"\x03\x41", 2: b"\x28\x00", 3: bytes(2), 4: bytes(2), 5: b"\x8f\x02" * 7, 6: bytes(2), 7: b"\x00\x67",
    8: bytes(1), 9: b",", 11: bytes(1), 12: b"".join(v.to_bytes(2, "little") for v in (2, 4, 8, 32, 64, 256, 512)),
    13: b"\x33\x73" * 7, 14: bytes(1), 15: b"miniBIRD  ", 17: bytes(1), 18: b"\x02", 19: bytes(1), 20: b"\x3c",
    22: bytes(2), 23: bytes(6), 24: bytes(6), 25: bytes(2), 26: bytes(2), 27: bytes(2), 28: bytes(10), 29: b"\x01",
    32: bytes(2), 35: bytes(1),
}  # fmt: skip
CHANGEABLE = {3, 4, 5, 6, 7, 8, 9, 11, 12, 13, 14, 17, 18, 20, 22, 23, 24, 28, 29, 32, 35}
AUTO_CONFIGURATION = 50
#: Commands that only the master takes.
MASTERS = b"FGA0/H"
FORMATS = b"VWXYZ\\]"
STATUS_FORMAT = {ord(c): n for c, n in zip("VWXYZ\\]", (1, 2, 3, 4, 5, 7, 8), strict=True)}
REPORTS = dict(zip(b"QRST", (1, 2, 8, 32), strict=True))
#: Before and after AUTO-CONFIG the line must be silent for this long.
SILENCE_S = 0.6
LARGEST = 8191  # of a 14-bit word


def word(value: float) -> int:
    """``value`` as the nearest 14-bit word, at its place in 16 bits; beyond full scale it sticks."""
    return 4 * int(min(max(round(value / 4.0), -LARGEST - 1), LARGEST))


def angles(rotation: Array) -> tuple[float, float, float]:
    """Azimuth, elevation and roll, rad, of R = Rz Ry Rx (3, 3)."""
    elevation = math.asin(min(1.0, max(-1.0, -float(rotation[2, 0]))))
    azimuth = math.atan2(float(rotation[1, 0]), float(rotation[0, 0]))
    return azimuth, elevation, math.atan2(float(rotation[2, 1]), float(rotation[2, 2]))


@dataclass
class Unit:
    """One bird's electronics, as after power-up."""

    address: int
    format: int = ord("Y")
    values: dict[int, bytes] = field(default_factory=lambda: dict(DEFAULTS))
    error: int = 0
    error_bit: bool = False
    streaming: bool = False
    halted: bool = False  # by XOFF
    report: int = 1  # every so many cycles
    extras: dict[int, bool] = field(default_factory=dict)  # whether 'M' or 's' append their byte to a record
    command: bytearray = field(default_factory=bytearray)  # what came so far at its own port

    def fail(self, code: int) -> None:
        self.error, self.error_bit = code, True


class Flock:
    """Units on one bus; ``addresses`` are those that are there, the lowest is the master with the transmitter.

    ``pose`` tells where a sensor is: transmitter_from_sensor. ``inverse`` has the quaternions in the other sense.
    """

    def __init__(
        self,
        addresses: Sequence[int],
        pose: Callable[[int], Rigid],
        silence_s: float = SILENCE_S,
        inverse: bool = False,
    ) -> None:
        self._addresses = tuple(sorted(addresses))
        self._pose = pose
        self._silence_s = silence_s
        self._inverse = inverse
        self.damaged = False  # transmitter mode 0 was sent
        self.mirrored = False  # the sensors are beyond their hemisphere
        self.power_cycle()

    def power_cycle(self) -> None:
        """Off and on: defaults, nothing configured, half commands forgotten."""
        self.units = {a: Unit(a) for a in self._addresses}
        self.master = self._addresses[0]
        self.configured = self.asleep = False
        self._cycles = 0
        self._last_byte_s = -math.inf
        self._began_quiet = True  # whether the command that is coming in came after silence

    @property
    def group(self) -> bool:
        return self.units[self.master].values[35] == b"\x01"

    @property
    def rate_hz(self) -> float:
        return max(20.0, min(144.0, int.from_bytes(self.units[self.master].values[7], "little") / 256.0))

    def receive(self, port: int, data: bytes, now_s: float) -> bytes:
        """What the unit at ``port`` (its address) answers to ``data``. Never raises."""
        out = b""
        for byte in data:
            unit = self.units[port]
            if not unit.command:
                self._began_quiet = now_s - self._last_byte_s >= self._silence_s
            self._last_byte_s = now_s
            unit.command.append(byte)
            out += self._try(port, unit.command)
        return out

    def _try(self, port: int, command: bytearray) -> bytes:
        """Carry out a command if it is whole, and forget it."""
        skip, address = 0, port
        if command[0] & 0xF0 == 0xF0:
            skip, address = 1, command[0] - 0xF0
        elif 0xE0 <= command[0] < 0xF0:
            skip, address = 1, command[0] - 0xE0 + 16
        elif command[0] == 0xA0:
            skip, address = 2, command[1] if len(command) > 1 else 0
        if len(command) <= skip:
            return b""
        code, arguments = command[skip], bytes(command[skip + 1 :])
        wanted = ARGUMENTS.get(code, 0)
        if code == ord("P") and arguments:
            wanted += 1 if arguments[0] == AUTO_CONFIGURATION else len(DEFAULTS.get(arguments[0], b""))
        if len(arguments) < wanted:
            return b""
        command.clear()
        if address not in self.units:
            self.units[port].fail(13)
            return b""
        return self._carry_out(port, self.units[address], code, arguments)

    def _carry_out(self, port: int, unit: Unit, code: int, arguments: bytes) -> bytes:
        if code not in ARGUMENTS or code == ord("z"):
            unit.fail(6)
        elif code in MASTERS and unit.address != self.master:
            unit.fail(7)
        elif code == ord("O"):
            return self._examine(unit, arguments[0])
        elif code == ord("P"):
            self._change(unit, arguments[0], arguments[1:])
        elif code in FORMATS:
            unit.format, unit.streaming = code, False
        elif code == ord("L"):
            unit.values[22] = arguments
        elif code in REPORTS:
            unit.report = REPORTS[code]
        elif code in b"Ms":
            unit.extras[code] = arguments[0] == 1
        elif code in b"FG":
            self.asleep = code == ord("G")
        elif code == 0x13:
            unit.halted = True
        elif code == 0x11:
            unit.halted = False
        elif code == ord("?"):
            self._stop(unit)
        elif code in b"B@":
            return self._report(unit, stream=code == ord("@"))
        elif code in b"Nt":
            return b"\x00"
        return b""

    def _stop(self, unit: Unit) -> None:
        for each in self.units.values() if self.group and unit.address == self.master else (unit,):
            each.streaming = False

    def _report(self, unit: Unit, stream: bool) -> bytes:
        self._stop(unit)
        if not self.configured:
            unit.fail(9)
            return b""
        if stream:
            unit.streaming = True
            return b""
        group = self.group and unit.address == self.master
        return b"".join(self.record(a) for a in (self.units if group else (unit.address,)))

    def _examine(self, unit: Unit, parameter: int) -> bytes:
        if parameter == 0:
            status = (
                (unit.address == self.master) << 15 | self.configured << 14 | unit.error_bit << 13
                | (self.configured and not self.asleep) << 12 | unit.halted << 6 | self.asleep << 5
                | STATUS_FORMAT[unit.format] << 1 | unit.streaming
            )  # fmt: skip
            unit.error_bit = False
            return status.to_bytes(2, "little")
        if parameter in (10, 16):
            error, unit.error = unit.error, 0
            return bytes((error,)) if parameter == 10 else bytes((error, 0))
        if parameter == 21:
            return bytes((unit.address,))
        if parameter == 36:
            return bytes(self._flock_status(a) for a in range(1, 15))
        if parameter == AUTO_CONFIGURATION:
            return bytes((1, *(self._present_bits(first) for first in (1, 8)), 0, 0))
        if parameter in unit.values:
            return unit.values[parameter]
        unit.fail(6)
        return b""

    def _present_bits(self, first: int) -> int:
        return sum(1 << k for k in range(7) if first + k in self.units)

    def _flock_status(self, address: int) -> int:
        if address not in self.units:
            return 0
        running = self.configured and not self.asleep
        return 0x80 | running << 6 | 0x20 | (address == self.master)

    def _change(self, unit: Unit, parameter: int, data: bytes) -> None:
        if parameter == AUTO_CONFIGURATION:
            if unit.address != self.master:
                unit.fail(7)
            elif not self._began_quiet:
                unit.fail(14)
            elif any(a not in self.units for a in range(1, data[0] + 1)):
                self.configured = False
                unit.fail(13)
            else:
                self.configured = True
        elif parameter in CHANGEABLE:
            self.damaged |= parameter == 18 and data == b"\x00"
            unit.values[parameter] = data
        else:
            unit.fail(6)

    def cycle(self) -> dict[int, bytes]:
        """The records that one measurement cycle sends, by the port (unit's address) that they leave by."""
        self._cycles += 1
        out: dict[int, bytes] = {}
        for unit in self.units.values():
            if unit.streaming and not unit.halted and self._cycles % unit.report == 0:
                group = self.group and unit.address == self.master
                out[unit.address] = b"".join(self.record(a) for a in (self.units if group else (unit.address,)))
        return out

    def record(self, address: int) -> bytes:
        """What a bird sends of where it is, in its format."""
        unit, pose = self.units[address], self._pose(address)
        axis = {0x00: 0, 0x06: 1, 0x0C: 2}.get(unit.values[22][0], 0)
        p = pose.position if (pose.position[axis] >= 0.0) == (unit.values[22][1] == 0) else -pose.position
        if self.mirrored:
            p = -p
        scale = POSITION_MM * (2.0 if unit.values[3] == b"\x01\x00" else 1.0)
        position = [word(v / scale) for v in p]
        q = pose.quaternion * np.array([1.0, -1.0, -1.0, -1.0]) if self._inverse else pose.quaternion
        quaternion = [word(32768.0 * v) for v in q]
        turn = [word(32768.0 * a / math.pi) for a in angles(pose.matrix)]
        matrix = [word(32768.0 * v) for v in pose.matrix.ravel()]
        words = {
            ord("V"): position, ord("W"): turn, ord("X"): matrix, ord("Y"): position + turn,
            ord("Z"): position + matrix, ord("\\"): quaternion, ord("]"): position + quaternion,
        }[unit.format]  # fmt: skip
        return encode(words) + bytes(sum(unit.extras.values())) + (bytes((address,)) if self.group else b"")
