"""What is said to a miniBIRD and what it answers: commands, parameters, status and error words.

Ascension, Flock of Birds Installation and Operation Guide, Rev B, "RS-232 commands". Words are 16 bits, the low byte
first; an argument is never sent apart from its command, since the unit waits for what is missing and hangs.
"""

from __future__ import annotations

from dataclasses import dataclass

POSITION_QUATERNION = b"]"
POSITION_ANGLES = b"Y"
POINT = b"B"
STREAM = b"@"
STREAM_STOP = b"?"
REPORT_EACH_CYCLE = b"Q"
NO_BUTTON = b"M\x00"  # BUTTON MODE: no byte of the buttons behind a record
NO_METAL = b"s\x00\x00"  # METAL: no byte of the field's distortion
RUN = b"F"
SLEEP = b"G"

# Parameters of EXAMINE VALUE and CHANGE VALUE.
STATUS = 0
POSITION_SCALE = 3
MEASUREMENT_RATE = 7
ERROR = 10
TRANSMITTER_MODE = 18
GROUP_MODE = 35
FLOCK_STATUS = 36
AUTO_CONFIGURATION = 50

#: HEMISPHERE's axis and sign: the half of space around the transmitter in which the sensors move.
HEMISPHERES = {
    "forward": b"\x00\x00",
    "aft": b"\x00\x01",
    "lower": b"\x0c\x00",
    "upper": b"\x0c\x01",
    "right": b"\x06\x00",
    "left": b"\x06\x01",
}

ERRORS = {
    1: "its memory is damaged (RAM); the unit needs repair",
    2: "its memory of settings cannot be written; the unit needs repair",
    3: "its board is not configured; the unit needs repair",
    4: "the transmitter is not connected; plug it into the master",
    5: "the sensor is not connected; plug it in",
    6: "it did not understand a command",
    7: "a command for the master reached another bird; is the port that of address 1?",
    8: "it sees no other bird; check the cable between the units",
    9: "the flock is not configured",
    10: "the bus between the units is disturbed; check its cable and terminators",
    11: "bytes to it were lost or garbled; check the baud rate and the cable",
    12: "the bus between the units is disturbed; check its cable and terminators",
    13: "a bird does not respond; check its power and fly switch",
    14: "a command on the bus between the units was not valid",
    15: "the bus between the units failed; switch the units off and on",
    16: "its processor runs at a wrong speed; the unit needs repair",
    17: "a bird gives no data; check its sensor",
    18: "its switches set no valid baud rate",
    19: "a bird does not acknowledge; check its power and address",
    28: "no signal to synchronise with",
    29: "the transmitter is not active",
    30: "the extended range transmitter is missing",
    31: "its processor has too much to do; ask for a lower measurement rate",
    32: "the sensor is saturated; it is too near the transmitter",
    33: "a bird is not configured",
    34: "its watchdog has restarted it; switch the unit off and on",
    35: "it is too hot; let it cool",
}


def error_text(code: int) -> str:
    """An error code in plain words."""
    return ERRORS.get(code, "its processor failed; switch the unit off and on" if 20 <= code <= 27 else "unknown")


def to_bird(address: int | None, command: bytes) -> bytes:
    """``command`` for one bird of the flock; None: the unit at the port. Raises ValueError beyond 30."""
    if address is None:
        return command
    if not 1 <= address <= 30:
        raise ValueError(f"a bird's address is 1 to 30, found {address}")
    prefix = 0xF0 + address if address < 16 else 0xE0 + address - 16
    return bytes((prefix,)) + command


def examine(parameter: int) -> bytes:
    return bytes((0x4F, parameter))


def change(parameter: int, data: bytes) -> bytes:
    """CHANGE VALUE. Raises ValueError for transmitter mode 0, which destroys a miniBIRD's transmitter circuit."""
    if parameter == TRANSMITTER_MODE and data[:1] == b"\x00":
        raise ValueError("transmitter mode 0 damages a miniBIRD and is never sent")
    return bytes((0x50, parameter)) + data


def hemisphere(name: str) -> bytes:
    return b"L" + HEMISPHERES[name]


def measurement_rate(hz: float) -> bytes:
    return change(MEASUREMENT_RATE, round(256.0 * hz).to_bytes(2, "little"))


@dataclass(frozen=True)
class UnitStatus:
    """Of the status word (parameter 0) of a unit, what the driver goes by."""

    master: bool
    expanded: bool  # addresses up to 30

    @staticmethod
    def read(reply: bytes) -> UnitStatus:
        word = int.from_bytes(reply, "little")
        return UnitStatus(master=bool(word >> 15 & 1), expanded=bool(word >> 10 & 1))


@dataclass(frozen=True)
class BirdStatus:
    """A bird's byte in the flock system status (parameter 36)."""

    accessible: bool
    running: bool
    sensor: bool

    @staticmethod
    def read(byte: int) -> BirdStatus:
        return BirdStatus(bool(byte & 0x80), bool(byte & 0x40), bool(byte & 0x20))
