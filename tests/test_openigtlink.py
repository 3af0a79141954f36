"""OpenIGTLink as bytes: what another implementation wrote is read, and nothing damaged ever passes."""

from __future__ import annotations

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from trainer.openigtlink import CONTENT, EXTENDED, HEADER, MessageParser, Transform, crc64, encode

#: The identity of device "A" at 1000.25 s, as pyigtl 0.3.4 packs it.
FROM_PYIGTL = bytes.fromhex(
    "00015452414e53464f524d0000004100000000000000000000000000000000000000000003e8400000000000000000000030"
    "b5a225f8f462b3d7"
    "3f8000000000000000000000000000003f8000000000000000000000000000003f800000000000000000000000000000"
)
ROTATION = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
QUARTER_TURN = Transform("ForcepsToTracker", np.array([1.0, -2.5, 300.125]), ROTATION, 12.5)


def message(kind: bytes, body: bytes, version: int = 1, device: bytes = b"D") -> bytes:
    return HEADER.pack(version, kind, device, 0, 0, len(body), crc64(body)) + body


def same(a: Transform, b: Transform) -> bool:
    return (
        (a.device, a.stamp_s) == (b.device, b.stamp_s)
        and np.array_equal(a.position, b.position)
        and np.array_equal(a.rotation, b.rotation)
    )


def test_the_checksum_is_that_of_ecma_182() -> None:
    """The catalogue's check value of CRC-64/ECMA-182: that of the nine digits."""
    assert crc64(b"123456789") == 0x6C40DF5F0B497347


def test_what_another_implementation_wrote_is_read_and_written_alike() -> None:
    [found] = MessageParser().feed(FROM_PYIGTL)
    identity = Transform("A", np.zeros(3), np.eye(3), 1000.25)
    assert same(found, identity)
    assert encode(identity) == FROM_PYIGTL


def test_a_pose_comes_back_and_its_rotation_is_not_the_inverse() -> None:
    """The numbers are float32 already, so nothing is rounded; the columns are written one after the other."""
    data = encode(QUARTER_TURN)
    [found] = MessageParser().feed(data)
    assert same(found, QUARTER_TURN)
    assert struct.unpack(">3f", data[58:70]) == (0.0, 1.0, 0.0)


@given(st.lists(st.integers(0, 3), max_size=6), st.lists(st.integers(0, 2000), max_size=10))
def test_no_split_changes_what_is_read(kinds: list[int], cuts: list[int]) -> None:
    parts = [encode(QUARTER_TURN), FROM_PYIGTL, message(b"STATUS", bytes(400)), message(b"IMAGE", b"")]
    data = b"".join(parts[k] for k in kinds)
    parser, found = MessageParser(), []
    ends = [*sorted(cuts), len(data)]
    for start, end in zip([0, *ends[:-1]], ends, strict=True):
        found += parser.feed(data[start:end])
    assert [t.device for t in found] == [("ForcepsToTracker", "A")[k] for k in kinds if k < 2]
    assert parser.counts["other messages"] == sum(k >= 2 for k in kinds)


@given(st.integers(0, 8 * 48 - 1))
def test_a_flipped_bit_of_a_body_is_found(bit: int) -> None:
    """A cyclic code finds any single error: the message is dropped, the next one read."""
    data = bytearray(encode(QUARTER_TURN))
    data[58 + bit // 8] ^= 1 << bit % 8
    parser = MessageParser()
    [found] = parser.feed(bytes(data) + FROM_PYIGTL)
    assert found.device == "A"
    assert parser.counts["damaged"] == 1


@given(st.lists(st.binary(max_size=300), max_size=8))
def test_no_bytes_raise_or_pile_up(pieces: list[bytes]) -> None:
    parser = MessageParser()
    for piece in pieces:
        parser.feed(piece)
        assert not parser.broken or not parser._buffer
    head = encode(QUARTER_TURN)[:14]
    for piece in pieces:  # behind a header's beginning that is in order
        MessageParser().feed(head + piece)


def test_an_extended_header_and_its_metadata_are_passed_by() -> None:
    content = encode(QUARTER_TURN)[HEADER.size :]
    body = EXTENDED.pack(EXTENDED.size, 4, 7, 1) + content + bytes(4) + b"keyword"
    [found] = MessageParser().feed(message(b"TRANSFORM", body, version=2, device=b"V3"))
    assert found.device == "V3"
    np.testing.assert_array_equal(found.rotation, ROTATION)


@pytest.mark.parametrize(
    ("body", "version"),
    [(b"", 1), (bytes(47), 1), (bytes(49), 1), (bytes(5), 2), (EXTENDED.pack(12, 9, 9, 0) + bytes(CONTENT.size), 2)],
)
def test_a_body_of_another_length_is_no_pose(body: bytes, version: int) -> None:
    parser = MessageParser()
    assert parser.feed(message(b"TRANSFORM", body, version)) == []
    assert parser.counts == {"damaged": 1}


def test_a_picture_passes_without_being_kept() -> None:
    parser = MessageParser()
    parser.feed(HEADER.pack(1, b"IMAGE", b"Probe", 0, 0, 10**6, 0))
    for _ in range(100):
        assert parser.feed(bytes(10**4)) == []
        assert len(parser._buffer) == 0
    assert len(parser.feed(FROM_PYIGTL)) == 1


@pytest.mark.parametrize(
    "data", [b"HTTP/1.1 400 Bad Request\r\n" * 3, bytes(58), b"\xff" * 58], ids=["http", "zeros", "ones"]
)
def test_another_service_is_told_from_openigtlink(data: bytes) -> None:
    parser = MessageParser()
    assert parser.feed(data) == []
    assert parser.broken == "what comes is not OpenIGTLink"
    assert parser.feed(FROM_PYIGTL) == []


def test_a_name_that_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match=r"at most 20 bytes, 'a{21}' has 21"):
        encode(Transform("a" * 21, np.zeros(3), np.eye(3), 0.0))
