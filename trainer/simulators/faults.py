"""What goes wrong on the way, as ``--fault`` names it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from trainer.config import ConfigError

#: Bytes of a group's record: what ``splice`` loses.
RECORD = 15
LONGEST_BURST = 60


@dataclass(frozen=True)
class Span:
    """From ``start_s``, for ``length_s``, s of motion; negative where it never happens."""

    start_s: float = -1.0
    length_s: float = 0.0

    def holds(self, time_s: float) -> bool:
        return 0.0 <= self.start_s <= time_s < self.start_s + self.length_s


@dataclass(frozen=True)
class Faults:
    """Rates are probabilities; times are in s of motion."""

    drop: float = 0.0  # of a byte
    flip: float = 0.0  # of a bit
    extra: float = 0.0  # of a byte that nobody sent, after a byte
    burst: float = 0.0  # that 1 to 60 bytes are lost, at a byte
    splice: float = 0.0  # that exactly a record's length is lost, at a byte
    split: bool = False  # writes of 1, 7, 16 or 62 bytes
    bunch: bool = False  # an adapter that hands over every 16 ms
    pause: Span = Span()
    unplug: Span = Span()
    hemisphere: Span = Span()
    power_cycle: Span = Span()  # its length is the time without power
    no_bird: int = 0  # the address of one that is not there
    mute: bool = False  # the stream never starts
    garbage: bool = False  # random bytes and no understanding
    stuck: Span = Span()  # closure sensor only
    out_of_range: Span = Span()  # closure sensor only

    def spoil(self, data: bytes, rng: np.random.Generator) -> bytes:
        """``data`` as the line delivers it."""
        if not (self.drop or self.flip or self.extra or self.burst or self.splice):
            return data
        raw = np.frombuffer(data, dtype=np.uint8).copy()
        if self.flip:
            flips = rng.random((len(raw), 8)) < self.flip
            raw ^= np.packbits(flips, axis=1).ravel()
        keep = rng.random(len(raw)) >= self.drop
        for rate, length in ((self.burst, 0), (self.splice, RECORD)):
            for start in np.flatnonzero(rng.random(len(raw)) < rate):
                keep[start : start + (length or int(rng.integers(1, LONGEST_BURST + 1)))] = False
        extra = rng.random(len(raw)) < self.extra
        out = bytearray()
        for byte, kept, more in zip(raw.tolist(), keep, extra, strict=True):
            if kept:
                out.append(byte)
            if more:
                out.append(int(rng.integers(0, 256)))
        return bytes(out)


#: What only a closure sensor can have, and what only trackers can.
CLOSURES = ("stuck", "out-of-range")
TRACKERS = ("hemisphere", "power-cycle", "no-bird", "mute", "garbage")


def parse(texts: Sequence[str]) -> tuple[Faults, Faults]:
    """Faults of the trackers and of the closure sensor: ``drop=0.01``, ``unplug=3:5``, ``closure:pause=2:1``.

    Raises ConfigError.
    """
    found: dict[str, dict[str, Any]] = {"": {}, "closure": {}}
    for text in texts:
        target = "closure" if text.startswith("closure:") else ""
        name, _, value = text.removeprefix("closure:").partition("=")
        found[target][name.replace("-", "_")] = _value(text, name, value)
    return Faults(**found[""]), Faults(**found["closure"])


def _value(text: str, name: str, value: str) -> float | int | bool | Span:
    known = {f.name.replace("_", "-"): f.default for f in fields(Faults)}
    others, whose = (TRACKERS, "a closure sensor") if text.startswith("closure:") else (CLOSURES, "a tracker")
    if name in others:
        raise ConfigError(f"--fault {text}: {whose} cannot have it")
    if name not in known:
        raise ConfigError(f"--fault {text}: unknown fault '{name}'; known: {', '.join(known)}")
    default = known[name]
    try:
        if isinstance(default, bool):
            if value:
                raise ValueError
            return True
        if isinstance(default, Span):
            start, _, length = value.partition(":")
            span = Span(float(start), float(length or "1"))
            if not (0.0 <= span.start_s < math.inf and 0.0 < span.length_s < math.inf):
                raise ValueError
            return span
        number = int(value) if isinstance(default, int) else float(value)
        if not (number >= 1 if isinstance(default, int) else 0.0 <= number <= 1.0):
            raise ValueError
        return number
    except ValueError:
        kinds = {bool: "no value", Span: "START:LENGTH in s", int: "an address"}
        kind = kinds.get(type(default), "a number from 0 to 1")
        raise ConfigError(f"--fault {text}: '{name}' takes {kind}") from None
