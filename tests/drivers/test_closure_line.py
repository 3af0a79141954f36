"""Lines of the closure sensor: any bytes in any split, and only lines with their checksum."""

from __future__ import annotations

import os
import time
from itertools import pairwise

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from trainer.drivers.closure_line import LONGEST, Counts, LineParser, checksum, encode

number = st.integers(0, 2**32 - 1)
count = st.integers(0, 1023)
lines = st.builds(encode, number, number, count, count)
streams = st.lists(st.one_of(lines, st.binary(max_size=90), lines.map(lambda s: s[:9])), max_size=20).map(b"".join)


def test_a_line_is_written_and_read_as_documented() -> None:
    """The exclusive or of "C,7,50000,120,860", byte by byte."""
    assert encode(7, 50000, 120, 860) == b"C,7,50000,120,860*4C\n"
    assert checksum(b"C,7,50000,120,860") == 0x4C
    assert LineParser().feed(b"C,7,50000,120,860*4C\r\n", 2.0) == [Counts(7, 50000, 120, 860, 2.0)]


@given(number, number, count, count)
def test_lines_come_back(seq: int, micros: int, left: int, right: int) -> None:
    assert LineParser().feed(encode(seq, micros, left, right), 1.0) == [Counts(seq, micros, left, right, 1.0)]


@given(number, number, count, count, st.integers(0, 200), st.integers(0, 7))
def test_a_flipped_bit_is_never_believed(seq: int, micros: int, left: int, right: int, at: int, bit: int) -> None:
    """An exclusive or sees every single flip. One that makes the line end early leaves no checksum."""
    data = bytearray(encode(seq, micros, left, right))
    data[at % (len(data) - 1)] ^= 1 << bit
    assert LineParser().feed(bytes(data), 1.0) == []


@given(streams)
def test_every_line_that_is_believed_stands_there(data: bytes) -> None:
    assert [(c.seq, c.micros, c.left, c.right) for c in LineParser().feed(data, 1.0)] == read_plainly(data)


def read_plainly(data: bytes) -> list[tuple[int, ...]]:
    """The documented lines among those that a newline ends, one rule after the other."""
    out = []
    for line in data.split(b"\n")[:-1]:
        body, star, check = line.removesuffix(b"\r").partition(b"*")
        name, *fields = body.split(b",")
        digits = all(f.isdigit() and len(f) <= n for f, n in zip(fields, (10, 10, 5, 5), strict=False))
        if name == b"C" and len(fields) == 4 and digits and star and len(line) < LONGEST:
            total = 0
            for byte in body:
                total ^= byte
            if check == b"%02X" % total:
                out.append(tuple(int(f) for f in fields))
    return out


@given(streams, st.lists(st.integers(0, 500), max_size=20))
def test_how_the_bytes_are_split_changes_nothing(data: bytes, cuts: list[int]) -> None:
    whole, split = LineParser(), LineParser()
    wanted = whole.feed(data, 0.0)
    edges = sorted({0, len(data), *(c for c in cuts if c < len(data))})
    assert [c for a, b in pairwise(edges) for c in split.feed(data[a:b], 0.0)] == wanted
    assert split.counts == whole.counts


@given(st.binary(max_size=200))
def test_after_any_bytes_the_second_line_is_believed(noise: bytes) -> None:
    parser = LineParser()
    parser.feed(noise, 0.0)
    found = parser.feed(encode(1, 2, 3, 4) + encode(2, 2, 3, 4), 0.0)
    assert found[-1] == Counts(2, 2, 3, 4, 0.0)


def test_lost_lines_are_counted_and_a_restart_is_none() -> None:
    parser = LineParser()
    for seq in (5, 6, 9, 0, 1, 2**32 - 1, 0):
        parser.feed(encode(seq, 0, 0, 0), 0.0)
    assert parser.counts == {"good": 7, "lost lines": 2}


def test_random_bytes_for_as_long_as_asked() -> None:
    """Memory stays that of one line. TRAINER_FUZZ_S seconds; 10 by default."""
    rng = np.random.default_rng(29)
    parser = LineParser()
    raw = np.frombuffer(encode(1, 2, 3, 4) * 20, dtype=np.uint8)
    ends = time.monotonic() + float(os.environ.get("TRAINER_FUZZ_S", "10"))
    while time.monotonic() < ends:
        data = raw.copy()
        hit = rng.random(len(data)) < rng.choice([0.001, 0.03, 1.0])
        data[hit] = rng.integers(0, 256, int(hit.sum()))
        parser.feed(data.tobytes(), 0.0)
        assert len(parser._line) <= LONGEST
