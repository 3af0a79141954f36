"""The stream of a flock tells why it is silent for as long as it is."""

from __future__ import annotations

import time
from collections import Counter
from types import SimpleNamespace
from typing import Any

import pytest
from waiting import wait_for

from trainer.drivers import minibird_stream
from trainer.drivers.minibird_record import MIRROR, Sample
from trainer.drivers.minibird_stream import FlockStream
from trainer.profile import Bird, MinibirdSpec

SPEC = MinibirdSpec(port="x", bird=(Bird(address=1, tool="left"), Bird(address=2, tool="right")))


class Line:
    """A port and its parser: all birds at first, then the second alone."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.fed = 0

    def read(self, count: int) -> bytes:
        time.sleep(0.005)
        return b"x"

    in_waiting = 0

    def feed(self, data: bytes, now_s: float) -> list[Sample]:
        self.fed += 1
        addresses = (1, 2) if self.fed < 5 else (2,)
        return [Sample(a, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), now_s, now_s, "") for a in addresses]


class Flock:
    """Notes what the stream says is wrong each time it is connected again."""

    def __init__(self, *told: Any) -> None:
        self.line = Line()
        self.parsers = {1: self.line}
        self.inverse: dict[int, bool] = {}
        self.stream: FlockStream | None = None
        self.said: list[str] = []

    def connect(self) -> None:
        if self.stream is not None:
            self.said.append(self.stream.trouble)

    def begin(self) -> dict[int, tuple[Line, Line]]:
        return {1: (self.line, self.line)}

    def disconnect(self) -> None:
        """There is nothing to give back."""


def test_why_one_bird_is_silent_stays_known_while_the_other_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reader, which waits for bytes when the silence is noticed, still hears the other bird after that."""
    flock = Flock()
    monkeypatch.setattr(minibird_stream, "Flock", lambda *told: flock)
    monkeypatch.setattr(minibird_stream, "SILENT_S", 0.1)
    monkeypatch.setattr(minibird_stream, "RETRY_S", 0.05)
    stream = FlockStream(SPEC, lambda sample: None)
    flock.stream = stream
    stream.start()
    assert wait_for(lambda: len(flock.said) >= 2)
    stream.close()
    assert set(flock.said) == {"bird 1 is silent"}


class Mirrored(Line):
    """By a clock of its own, on which 10 ms pass from record to record: every one is from the other hemisphere."""

    now_s = 0.0

    def read(self, count: int) -> bytes:
        self.now_s += 0.01
        return super().read(count)

    def feed(self, data: bytes, now_s: float) -> list[Sample]:
        self.fed += 1
        return [Sample(a, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), now_s, now_s, MIRROR) for a in (1, 2)]


def test_a_bird_in_the_other_hemisphere_is_not_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    """For three times as long as a silence may last, the stream goes on without being begun again."""
    flock = Flock()
    line = flock.line = Mirrored()
    flock.parsers = {1: line}
    monkeypatch.setattr(minibird_stream, "Flock", lambda *told: flock)
    monkeypatch.setattr(minibird_stream, "time", SimpleNamespace(monotonic=lambda: line.now_s))
    stream = FlockStream(SPEC, lambda sample: None)
    stream.start()
    assert wait_for(lambda: line.now_s > 3.0 * minibird_stream.SILENT_S)
    stream.close()
    assert (stream.restarts, stream.trouble) == (0, "")
