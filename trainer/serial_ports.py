"""The serial ports of this machine, and which shipped profile takes which."""

from __future__ import annotations

from dataclasses import dataclass

from serial.tools import list_ports

#: By the number of a USB maker: what it makes that ends in a serial port. From the public list of USB identifiers.
BOARDS = {0x2341: "Arduino", 0x2A03: "Arduino", 0x1A86: "CH340 of a board"}
ADAPTERS = {0x0403: "FTDI adapter", 0x067B: "Prolific adapter", 0x10C4: "CP210x adapter"}


@dataclass(frozen=True)
class Port:
    """One port and what could be at its end."""

    port: str
    what: str  # as the system describes it
    fits: str  # the profile and the table of it whose ``port`` it may be


def found() -> list[Port]:
    """All serial ports, by name."""
    return [
        Port(p.device, _what(p.vid, p.description), _fits(p.vid))
        for p in sorted(list_ports.comports(), key=lambda p: str(p.device))
    ]


def _what(vendor: int | None, description: str | None) -> str:
    told = "" if description in (None, "", "n/a") else str(description)
    return told or BOARDS.get(vendor or 0) or ADAPTERS.get(vendor or 0) or "serial port"


def _fits(vendor: int | None) -> str:
    """Trackers speak RS-232, through a port of the machine or an adapter; closure sensors are boards."""
    if vendor in BOARDS:
        return "minibird-pair: [closure]"
    if vendor is None or vendor in ADAPTERS:
        return "minibird-pair: [minibird]"
    return "minibird-pair: [minibird] or [closure]"
